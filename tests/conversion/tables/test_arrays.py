import io
import tracemalloc
import zipfile
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conversion.tables import arrays as table_arrays
from conversion.tables.arrays import ArrayRows, FolderStore, NpzStore
from semantic2d_dataset.errors import RecordingError

RANGES = np.arange(30, dtype=np.float64).reshape(10, 3) / 4


@pytest.fixture(params=["folder", "npz", "packed npz"])
def store(request, tmp_path):
    def save(**arrays):
        if request.param == "folder":
            for name, array in arrays.items():
                np.save(tmp_path / f"{name}.npy", array)
            return ArrayRows(FolderStore(tmp_path))
        write = np.savez if request.param == "npz" else np.savez_compressed
        write(tmp_path / "a.npz", **arrays)
        return ArrayRows(NpzStore(tmp_path / "a.npz"))

    return save


def rows_of(opened, size=512, **selectors):
    blocks = list(opened.blocks(selectors, size))
    return {name: np.concatenate([block[name] for block in blocks]) for name in selectors}


def test_arrays_come_out_row_by_row(store):
    opened = store(r=RANGES, i=RANGES.astype(np.uint16))
    found = rows_of(opened, 4, ranges="r", intensities="i")
    np.testing.assert_array_equal(found["ranges"], RANGES)
    assert found["intensities"].dtype == np.uint16
    assert [len(b["ranges"]) for b in opened.blocks({"ranges": "r"}, 4)] == [4, 4, 2]


def test_small_arrays_are_read_whole_and_stacked(store):
    stamps = np.int64(1_700_000_000_123_456_789) + np.arange(10)
    opened = store(r=RANGES, t=stamps, x=np.arange(10), yz=np.ones((10, 2)))
    found = opened.contents("r", "t", 10**9, {"poses": ("x", "yz")})
    assert (found.rows, found.beams) == (10, 3)
    np.testing.assert_array_equal(found.stamps_ns, stamps)
    np.testing.assert_array_equal(found.others["poses"][:, 0], np.arange(10))


def test_stamps_in_seconds_are_rounded_to_the_nearest_nanosecond(store):
    opened = store(r=RANGES, t=np.arange(10)[:, None] * 0.1)
    found = opened.contents("r", "t", 1, {}).stamps_ns
    np.testing.assert_array_equal(found, np.arange(10) * 10**8)


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ({"r": RANGES[0]}, r"ranges: expected an array \(N, B\), found \(3,\) in r"),
        ({"q": RANGES}, "no array 'r'; it holds q"),
        ({"r": RANGES.astype("S5")}, r"expected numbers, found an array of \|S5"),
        ({"r": RANGES, "t": np.arange(9)}, "stamps: expected one for each of 10 scans, found 9"),
        ({"r": RANGES, "t": np.full(10, np.nan)}, "10 are not finite"),
        ({"r": RANGES, "t": np.full(10, 1.7e18)}, "beyond the year 2116; is stamp_unit"),
        ({"r": RANGES, "p": np.ones((9, 3))}, r"poses: expected a row for each of 10.*\(9, 3\)"),
        ({"r": RANGES, "i": RANGES[:, :2]}, r"intensities: expected \(10, 3\) as the ranges"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(store, arrays, problem):
    opened = store(**arrays)
    small = {"poses": "p"} if "p" in arrays else {}
    large = {"ranges": "r"} | ({"intensities": "i"} if "i" in arrays else {})
    with pytest.raises(RecordingError, match=problem):
        opened.contents("r", "t" if "t" in arrays else None, 1, small)
        list(opened.blocks(large, 512))


def test_a_folder_may_hold_one_file_for_each_scan_in_the_order_of_their_numbers(tmp_path):
    (tmp_path / "scans").mkdir()
    for i in (0, 1, 2, 10, 11, 100):
        np.save(tmp_path / "scans" / f"{i}.npy", np.full(3, i))
    opened = ArrayRows(FolderStore(tmp_path))
    assert opened.contents("scans", None, 1, {}).rows == 6
    found = rows_of(opened, 4, ranges="scans")["ranges"]
    np.testing.assert_array_equal(found[:, 0], [0, 1, 2, 10, 11, 100])
    assert len(opened.files(["scans"])) == 6
    np.save(tmp_path / "scans" / "5.npy", np.zeros(4))
    with pytest.raises(RecordingError, match=r"5.npy: expected \(3,\).*found \(4,\)"):
        rows_of(opened, ranges="scans")


@pytest.mark.parametrize("name", ["../a", "/etc/a", "b/../../a"])
def test_no_file_outside_the_folder_is_read(tmp_path, name):
    with pytest.raises(RecordingError, match="expected a name in this folder"):
        FolderStore(tmp_path).files(name)


def test_pickled_objects_are_never_loaded(store):
    opened = store(r=np.array([{"a": 1}, None], dtype=object))
    with pytest.raises(RecordingError, match="pickled"):
        opened.contents("r", None, 1, {})


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(table_arrays, "_MAX_PACKED_BYTES", 1 << 20)
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, r=np.zeros((3 << 10, 1 << 8), np.float32))
    tracemalloc.start()
    with pytest.raises(RecordingError, match="r: 3145856 bytes in .* no measured array packs"):
        ArrayRows(NpzStore(path)).contents("r", None, 1, {})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20
    np.savez_compressed(path, r=np.random.default_rng(0).random((3 << 10, 1 << 6)))
    assert ArrayRows(NpzStore(path)).contents("r", None, 1, {}).rows == 3 << 10


def npz_with(path, content, name="r.npy"):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, content)
    return ArrayRows(NpzStore(path))


def npy(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def test_an_array_that_lies_about_its_length_is_refused(tmp_path):
    whole = npy(RANGES)
    short = npz_with(tmp_path / "short.npz", whole[:-8])
    with pytest.raises(RecordingError, match="expected 10 rows, found it cut after row 8"):
        rows_of(short, 4, ranges="r")
    long = npz_with(tmp_path / "long.npz", whole + b"more")
    with pytest.raises(RecordingError, match="holds more than the 10 rows"):
        rows_of(long, ranges="r")
    endless = whole.replace(b"(10, 3), }", b"(10, 3 * 9)")
    with pytest.raises(RecordingError, match="header cannot be read"):
        rows_of(npz_with(tmp_path / "endless.npz", endless), ranges="r")


def test_an_array_of_many_numbers_is_not_read_whole(tmp_path):
    folder = tmp_path / "f"
    folder.mkdir()
    np.lib.format.open_memmap(folder / "t.npy", mode="w+", dtype=np.float64, shape=(40_000_000,))
    np.save(folder / "r.npy", RANGES)
    with pytest.raises(RecordingError, match="expected a few numbers for each scan"):
        ArrayRows(FolderStore(folder)).contents("r", "t", 1, {})


def test_an_array_stored_by_columns_is_refused_in_a_npz_only(tmp_path):
    np.savez(tmp_path / "a.npz", r=np.asfortranarray(RANGES))
    with pytest.raises(RecordingError, match="stored column by column"):
        ArrayRows(NpzStore(tmp_path / "a.npz")).contents("r", None, 1, {})
    np.save(tmp_path / "r.npy", np.asfortranarray(RANGES))
    found = rows_of(ArrayRows(FolderStore(tmp_path)), ranges="r")["ranges"]
    np.testing.assert_array_equal(found, RANGES)


@given(st.integers(0, 10**6), st.integers(0, 255), st.booleans())
def test_a_damaged_npz_gives_its_rows_or_our_own_error(tmp_path_factory, at, byte, cut):
    path = tmp_path_factory.mktemp("npz") / "a.npz"
    np.savez(path, r=RANGES)
    content = bytearray(path.read_bytes())
    at %= len(content)
    content[at] = byte
    path.write_bytes(bytes(content[:at] if cut else content))
    with suppress(RecordingError):
        found = rows_of(ArrayRows(NpzStore(path)), ranges="r")["ranges"]
        assert len(found) == 10


@given(st.integers(0, 10**6), st.integers(0, 255), st.booleans())
def test_a_damaged_npy_gives_rows_or_our_own_error(tmp_path_factory, at, byte, cut):
    folder = tmp_path_factory.mktemp("npy")
    content = bytearray(npy(RANGES))
    at %= len(content)
    content[at] = byte
    (folder / "r.npy").write_bytes(bytes(content[:at] if cut else content))
    with suppress(RecordingError):
        rows_of(ArrayRows(FolderStore(folder)), ranges="r")
