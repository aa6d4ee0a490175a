from __future__ import annotations

import bz2
import tracemalloc

import lz4.frame
import pytest

from conversion.ros.compression import MAX_PIECE, decompress, decompress_message, zstd

DATA = bytes(range(256)) * 40
PACKED = {
    "none": DATA,
    "": DATA,
    "lz4": lz4.frame.compress(DATA),
    "bz2": bz2.compress(DATA),
    "zstd": zstd.compress(DATA),
}


@pytest.mark.parametrize("codec", PACKED)
def test_a_chunk_is_what_was_packed(codec):
    assert decompress(codec, PACKED[codec], len(DATA)) == DATA


@pytest.mark.parametrize("codec", PACKED)
@pytest.mark.parametrize("size", [0, 1, len(DATA) - 1, len(DATA) + 1])
def test_a_chunk_of_another_size_than_announced_is_refused(codec, size):
    with pytest.raises(ValueError, match=f"has not the {size} bytes that its header"):
        decompress(codec, PACKED[codec], size)


@pytest.mark.parametrize(
    "pack", [bz2.compress, lz4.frame.compress, zstd.compress], ids=["bz2", "lz4", "zstd"]
)
def test_a_bomb_never_takes_more_than_was_announced(pack, request):
    codec = request.node.callspec.id
    bomb = pack(bytes(100_000_000))
    tracemalloc.start()
    with pytest.raises(ValueError, match="has not the 1000 bytes"):
        decompress(codec, bomb, 1000)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10_000_000


def test_more_than_fits_in_memory_is_never_begun():
    with pytest.raises(ValueError, match="more than can be read"):
        decompress("bz2", PACKED["bz2"], MAX_PIECE + 1)


def test_an_unknown_codec_is_named():
    with pytest.raises(ValueError, match="compressed by 'snappy', which is not known"):
        decompress("snappy", DATA, 1)


def test_a_message_is_decompressed_whole_or_not_at_all(monkeypatch):
    assert decompress_message(PACKED["zstd"]) == DATA
    with pytest.raises(ValueError, match="is damaged"):
        decompress_message(PACKED["zstd"][:-5])
    monkeypatch.setattr("conversion.ros.compression.MAX_PIECE", 1000)
    with pytest.raises(ValueError, match="is damaged"):
        decompress_message(PACKED["zstd"])
