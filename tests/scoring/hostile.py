"""Predictions files that must be refused: crafted ones, and random mutations of a good one.

Each builder gets a copy of a good file, open for writing, and spoils it. `FIRST` is a sequence of
the good file with `ROWS` scans of `BEAMS` beams.
"""

import json
import zlib

import h5py
import numpy as np

FIRST, ROWS, BEAMS = "hall--a--near", 68, 12
CRAFTED = {}
GROUP = f"predictions/{FIRST}"
LABELS, INDEX, META = f"{GROUP}/labels", f"{GROUP}/scan_index", "metadata"
SAMPLES = f"{GROUP}/samples"


def crafted(build):
    CRAFTED[build.__name__.replace("_", " ")] = build
    return build


def put(file, name, array, **options):
    """Replace an array, stored as the format wants it unless told otherwise."""
    if name in file:
        del file[name]
    options = {"chunks": array.shape, "fletcher32": True} | options
    return file.create_dataset(name, data=array, **options)


def bomb(file, name, shape, chunks, dtype, maxshape=None):
    """Declare a large array whose every chunk is the same few bytes of deflated zeros."""
    if name in file:
        del file[name]
    options = {"compression": "gzip", "fletcher32": True, "maxshape": maxshape}
    array = file.create_dataset(name, shape, dtype, chunks=chunks, **options)
    packed = zlib.compress(bytes(int(np.prod(chunks)) * np.dtype(dtype).itemsize))
    for at in np.ndindex(*(-(-n // c) for n, c in zip(shape, chunks, strict=True))):
        start = tuple(int(a * c) for a, c in zip(at, chunks, strict=True))
        array.id.write_direct_chunk(start, packed, filter_mask=0b10)  # 10: no checksum kept


def meta(file, text):
    put(file, META, np.frombuffer(text, np.uint8))


def labels(value=0, dtype=np.uint8, shape=(ROWS, BEAMS)):
    return np.full(shape, value, dtype)


def links():
    yield (
        "external link to labels",
        lambda f, out: f.__setitem__(LABELS, h5py.ExternalLink(out, LABELS)),
    )
    yield (
        "external link to a group",
        lambda f, out: f.__setitem__("predictions/x", h5py.ExternalLink(out, "/")),
    )
    yield "soft link to labels", lambda f, _: f.__setitem__(LABELS, h5py.SoftLink(f"/{INDEX}"))
    yield (
        "soft link to nothing",
        lambda f, _: f.__setitem__(SAMPLES, h5py.SoftLink("/no")),
    )
    yield "hard link in a circle", lambda f, _: f.__setitem__("predictions/x", f["/"])
    yield "hard link to another part", lambda f, _: f.__setitem__(SAMPLES, f[INDEX])


def relink(change):
    def build(file, canary):
        del file[LABELS], file[SAMPLES]
        change(file, str(canary))

    return build


CRAFTED |= {name: relink(change) for name, change in links()}


@crafted
def external_storage(file, canary):
    del file[LABELS]
    external = [(str(canary), 0, ROWS * BEAMS)]
    file.create_dataset(LABELS, (ROWS, BEAMS), np.uint8, external=external)


@crafted
def virtual_data(file, canary):
    del file[LABELS]
    layout = h5py.VirtualLayout((ROWS, BEAMS), np.uint8)
    layout[:] = h5py.VirtualSource(str(canary), "x", (ROWS, BEAMS))
    file.create_virtual_dataset(LABELS, layout)


@crafted
def huge_labels_that_are_not_there(file, _):
    del file[LABELS]
    file.create_dataset(LABELS, (1 << 40, 1 << 10), np.uint8, chunks=(64, 64), fletcher32=True)


@crafted
def many_rows_that_are_not_there(file, _):
    del file[LABELS]
    file.create_dataset(LABELS, (1 << 30, BEAMS), np.uint8, chunks=(1 << 20, 12), fletcher32=True)


@crafted
def bomb_of_scan_indices(file, _):
    bomb(file, INDEX, (60_000_000,), (2_000_000,), np.int64)


@crafted
def bomb_of_labels(file, _):
    bomb(file, LABELS, (2_000_000, 128), (400_000, 128), np.uint8)


@crafted
def bomb_of_samples(file, _):
    bomb(file, SAMPLES, (60_000, ROWS, BEAMS), (60_000, ROWS, BEAMS), np.uint8)


@crafted
def bomb_of_thousand_samples_in_one_chunk_a_scan(file, _):
    shape = (1024, ROWS, BEAMS)
    bomb(file, SAMPLES, shape, (1024, 1, BEAMS), np.uint8)


@crafted
def bomb_of_probabilities(file, _):
    bomb(
        file, f"{GROUP}/probabilities", (ROWS, BEAMS, 10), (64, 1000, 500), np.float16, (None,) * 3
    )


@crafted
def chunk_of_a_gigabyte(file, _):
    del file[LABELS]
    options = {"maxshape": (None, None), "fletcher32": True}
    file.create_dataset(LABELS, (ROWS, BEAMS), np.uint8, chunks=(1 << 15, 1 << 15), **options)


@crafted
def no_checksums(file, _):
    put(file, LABELS, labels(), fletcher32=False)


@crafted
def contiguous(file, _):
    del file[LABELS]
    file.create_dataset(LABELS, data=labels())


@crafted
def other_compression(file, _):
    put(file, LABELS, labels(), compression="lzf")


@crafted
def scale_offset(file, _):
    put(file, LABELS, labels(), scaleoffset=4, fletcher32=False)


@crafted
def ten_thousand_groups(file, _):
    for n in range(10_000):
        file.create_group(f"predictions/g{n}")


@crafted
def a_thousand_groups(file, _):
    for n in range(1_000):
        file.create_group(f"predictions/g{n}")


@crafted
def names_for_terminals(file, _):
    file.create_group("predictions/\x1b]0;owned\x07\u202e")


@crafted
def a_name_that_is_a_path(file, _):
    file["predictions"].id  # noqa: B018
    put(file, "predictions/../../etc/labels", labels())


@crafted
def a_name_of_many_letters(file, _):
    file.create_group("predictions/" + "x" * 60_000)


@crafted
def a_group_too_deep(file, _):
    file.create_group(GROUP + "/a" * 500)


@crafted
def an_array_for_a_group(file, _):
    del file["predictions"]
    put(file, "predictions", labels())


@crafted
def a_group_for_an_array(file, _):
    del file[LABELS]
    file.create_group(LABELS)


@crafted
def a_named_type(file, _):
    file["predictions/type"] = np.dtype("f8")


@crafted
def an_unknown_attribute(file, _):
    file.attrs["evil"] = 1


@crafted
def an_attribute_of_variable_length(file, _):
    file.attrs["dataset"] = "toy"


@crafted
def a_large_attribute(file, _):
    file.attrs["dataset"] = np.bytes_(b"x" * 60_000)


@crafted
def an_attribute_of_another_type(file, _):
    file.attrs["split"] = np.arange(4)


@crafted
def an_attribute_that_is_no_text(file, _):
    file.attrs["split"] = np.bytes_(b"\xff\xfe")


@crafted
def a_newer_format(file, _):
    file.attrs["format_version"] = np.bytes_("99.0")


@crafted
def no_version(file, _):
    del file.attrs["format_version"]


@crafted
def another_kind(file, _):
    file.attrs["format"] = np.bytes_("semantic2d-sequence")


@crafted
def a_scheme_that_is_a_path(file, _):
    file.attrs["scheme"] = np.bytes_("../../../etc/passwd")


METADATA = {
    "deep": b"[" * 60_000,
    "deep and closed": b"[" * 30_000 + b"]" * 30_000,
    "wide": b"[" + b"[]," * 20_000 + b"[]]",
    "long": b'{"method": "' + b"x" * 10_000_000 + b'"}',
    "digits": b'{"method": "m", "parameters": ' + b"9" * 60_000 + b"}",
    "large number": b'{"method": "m", "parameters": ' + b"9" * 4_000 + b"}",
    "exponent": b'{"method": "m", "scans_per_second": 1e999}',
    "not a number": b'{"method": "m", "scans_per_second": NaN}',
    "surrogate": b'{"method": "\\ud800"}',
    "escape": b'{"method": "\\u001b[2J"}',
    "zero byte": b'{"method": "\\u0000"}',
    "right to left": '{"method": "\u202ecod"}'.encode(),
    "script": b'{"method": "m", "paper": "javascript:alert(1)"}',
    "markup": b'{"method": "m", "code": "https://a.org/\\"><script>"}',
    "no method": b"{}",
    "many keys": json.dumps({"method": "m"} | {f"k{n}": n for n in range(4_000)}).encode(),
    "nested": b'{"method": "m", "authors": [[["x"]]]}',
    "list": b'["method"]',
    "null": b"null",
    "no text": b"\xff\xfe\x00",
    "yaml": b"!!python/object/apply:os.system [x]",
    "pickle": b"\x80\x04\x95\x1a\x00\x00\x00\x00\x00\x00\x00.",
}
CRAFTED |= {
    f"metadata: {name}": (lambda file, _, text=text: meta(file, text))
    for name, text in METADATA.items()
}

DTYPES = ("i1", ">u2", "u2", "i8", "f4", "f8", "c8", "S4", "?", [("a", "u1"), ("b", "u1")])
CRAFTED |= {
    f"labels of {dtype}": (lambda file, _, dtype=dtype: put(file, LABELS, labels(0, dtype)))
    for dtype in DTYPES
}
CRAFTED |= {
    f"indices of {dtype}": (
        lambda file, _, dtype=dtype: put(file, INDEX, file[INDEX][:].astype(dtype))
    )
    for dtype in ("i4", "u8", ">i8", "f8")
}
for part, value in (("labels", 10), ("labels", 255), ("scan_index", -1), ("scan_index", 2**62)):
    CRAFTED[f"{part} {value}"] = lambda file, _, part=part, value=value: file[
        f"{GROUP}/{part}"
    ].__setitem__(3, value)
for name, held in {"nan": np.nan, "inf": np.inf, "negative": -0.1, "zero": 0.0, "two": 2}.items():
    CRAFTED[f"probabilities {name}"] = lambda file, _, held=held: put(
        file, f"{GROUP}/probabilities", np.full((ROWS, BEAMS, 10), held, np.float16)
    )


def mutation(seed):
    """Return a random change of structure, dtype, shape, ids or label domain."""
    rng = np.random.default_rng(seed)
    kind = ("structure", "dtype", "shape", "ids", "labels", "cut")[seed % 6]

    def build(file, _):
        name = str(
            rng.choice(
                [f"predictions/{n}/{p}" for n, parts in file["predictions"].items() for p in parts]
            )
        )
        values = file[name][:]
        if kind == "structure":
            change = rng.integers(3)
            if change == 0:
                del file[name]
            elif change == 1:
                file.move(name, f"{name}{rng.integers(10)}")
            else:
                file.move(name.rsplit("/", 1)[0], f"predictions/hall--{rng.integers(99)}--near")
        elif kind == "dtype":
            others = [
                d for d in ("u1", "i1", "u2", "i4", "u4", "i8", "f2", "f8") if values.dtype != d
            ]
            put(file, name, values.astype(rng.choice(others)))
        elif kind == "shape":
            axis = int(rng.integers(values.ndim))
            change = rng.integers(3)
            kept = np.delete(values, rng.integers(values.shape[axis]), axis)
            longer = np.concatenate((values, values), axis)
            put(file, name, (kept, longer, values[None])[change])
        elif kind == "ids":
            name = name.rsplit("/", 1)[0] + "/scan_index"
            values = file[name][:]
            at = rng.integers(len(values))
            values[at] = rng.choice([values[at - 1], -1, 1, 70, 10**6, -(2**63), 2**63 - 1])
            put(file, name, values)
        elif kind == "labels":
            name = name.rsplit("/", 1)[0] + str(rng.choice(["/labels", "/samples"]))
            values = file[name][:]
            values[tuple(rng.integers(values.shape))] = rng.integers(10, 256)
            put(file, name, values)

    return kind, rng, build


def spoil_bytes(content, rng):
    """Cut a file, or zero a part of it from its data on."""
    return content[: int(rng.integers(0, len(content)))]
