"""Exports of sequences come back as they were, or are refused."""

import hashlib
import json
from fnmatch import fnmatch

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from conversion.exports.exported import is_exported
from conversion.exports.mcap import END_TOPIC, SEQUENCE_TOPIC, export_mcap
from conversion.options import Options
from conversion.plan import BLOCK
from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from semantic2d_dataset.errors import InvalidInputError, RecordingError
from semantic2d_dataset.format.schema import SEQUENCE
from semantic2d_dataset.format.sequence import SequenceReader
from tests.conversion.exports.sequences import (
    LIDAR,
    full_arrays,
    import_export,
    open_export,
    random_arrays,
    random_map,
    random_sequence,
    rewrite,
    write_sequence,
)
from tests.conversion.recordings import straight_drive

STORE = get_typestore(Stores.ROS2_HUMBLE)
CARRIERS = (
    "/scan",
    "/scan/labels",
    "/map",
    "/semantic2d/map/labels",
    "/semantic2d/poses/refined",
    "/semantic2d/alignment/covariance",
    "/semantic2d/lines/segments",
    "/semantic2d/streams/n2nd_odom/data",
)
ARRAYS = (
    "scans/stamps_ns",
    "scans/ranges",
    "scans/intensities",
    "scans/labels",
    "scans/confidence",
    "poses/refined",
    "alignment/covariance",
    "lines/segments",
    "streams/2nd-odom/data",
)
STRING = "std_msgs/msg/String"
CLOUD = "sensor_msgs/msg/PointCloud2"


def digest(path):
    with SequenceReader(path) as reader:
        return reader.content_digest()


def blocks_of(path, options=None):
    """The arrays of an export, joined."""
    found: dict[str, list[np.ndarray]] = {}
    with open_export(path) as source:
        (plan,) = source.plans(options or Options())
        for arrays in plan.blocks():
            for name, rows in arrays.items():
                found.setdefault(name, []).append(rows)
    return {name: np.concatenate(rows) for name, rows in found.items()}


def bits(arrays):
    return {name: (a.dtype.str, a.shape, a.tobytes()) for name, a in arrays.items()}


def said(text):
    message = STORE.types[STRING](data=text)
    return bytes(STORE.serialize_cdr(message, STRING))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A small export with every kind of carrier, and the arrays that it must give."""
    folder = tmp_path_factory.mktemp("export")
    rng = np.random.default_rng(1)
    arrays = {name: array for name, array in full_arrays(rng).items() if name in ARRAYS}
    write_sequence(folder / "a.h5", arrays, scene=random_map(rng))
    export_mcap(folder / "a.h5", folder / "a.mcap")
    return folder / "a.mcap", arrays


@pytest.mark.parametrize("seed", range(4))
def test_a_sequence_comes_back_identical(seed, tmp_path):
    path = random_sequence(tmp_path / "a.h5", seed)
    export_mcap(path, tmp_path / "a.mcap")
    back = import_export(tmp_path / "a.mcap", tmp_path / "b.h5")
    assert digest(back) == digest(path)
    with SequenceReader(path) as one, SequenceReader(back) as two:
        assert two.header.lidar == one.header.lidar
        assert two.header.taxonomy == one.header.taxonomy
        assert two.header.license == "CC-BY-4.0"
        assert two.header.stamps_source == "record"
        assert two.header.provenance == {"exported": one.header.provenance}


def test_every_array_that_the_format_has_comes_back_with_its_bits(tmp_path):
    arrays = full_arrays(np.random.default_rng(2))
    write_sequence(tmp_path / "a.h5", arrays)
    export_mcap(tmp_path / "a.h5", tmp_path / "a.mcap")
    assert bits(blocks_of(tmp_path / "a.mcap")) == bits(arrays)
    known = {name for name in SEQUENCE.arrays if not name.startswith(("map/", "prov"))}
    assert not [name for name in known if not any(fnmatch(each, name) for each in arrays)]


def test_more_scans_than_a_block_come_back_in_order(tmp_path):
    rng = np.random.default_rng(4)
    arrays = random_arrays(rng, 2 * BLOCK + 3)
    write_sequence(tmp_path / "a.h5", arrays)
    export_mcap(tmp_path / "a.h5", tmp_path / "folder")
    assert bits(blocks_of(tmp_path / "folder")) == bits(arrays)
    with open_export(tmp_path / "folder") as source:
        (plan,) = source.plans(Options())
        sizes = [len(b["scans/ranges"]) for b in plan.blocks() if "scans/ranges" in b]
    assert sizes == [BLOCK, BLOCK, 3]


def test_a_sequence_without_scans_comes_back(tmp_path):
    empty = {"scans/ranges": np.empty((0, LIDAR.beams), np.float32)}
    write_sequence(tmp_path / "a.h5", empty | {"scans/stamps_ns": np.empty(0, np.int64)})
    export_mcap(tmp_path / "a.h5", tmp_path / "a.mcap")
    assert digest(import_export(tmp_path / "a.mcap", tmp_path / "b.h5")) == digest(
        tmp_path / "a.h5"
    )


def test_the_plan_says_what_the_export_holds(exported):
    path, arrays = exported
    with open_export(path) as source:
        (plan,) = source.plans(Options())
        assert source.kind == "exported sequence"
        assert list(source.files()) == [path]
        assert "rosbags" in source.versions
    known = np.isfinite(arrays["poses/refined"]).all(axis=1).sum()
    stamps = arrays["scans/stamps_ns"]
    assert (plan.scans_in, plan.scans_out, plan.scans_with_pose) == (6, 6, known)
    assert plan.duration_s == (stamps[-1] - stamps[0]) / 1e9
    assert (plan.topic, plan.header.sequence_id) == ("/scan", "lab--one--odd.lidar_2")


def test_ordinary_recordings_are_no_exports(exported, tmp_path):
    with RosRecording(Bag(straight_drive("mcap").write(tmp_path))) as recording:
        assert not is_exported(recording)
    with RosRecording(Bag(exported[0])) as recording:
        assert is_exported(recording)


def test_names_and_licence_can_be_chosen(exported):
    with open_export(exported[0]) as source:
        chosen = Options(environment="hall", recording="two", license="CC0-1.0")
        (plan,) = source.plans(chosen)
        assert plan.header.sequence_id == "hall--two--odd.lidar_2"
        assert plan.header.license == "CC0-1.0"
        with pytest.raises(InvalidInputError, match="environment 'Bad Name'"):
            source.plans(Options(environment="Bad Name"))


@pytest.mark.parametrize(
    "changed",
    [{"lidar": "hokuyo"}, {"drop_without_pose": True}, {"streams": ("all",)}, {"poses": "tf"}],
)
def test_options_that_would_change_the_sequence_are_refused(changed, exported):
    with (
        open_export(exported[0]) as source,
        pytest.raises(InvalidInputError, match=f"{next(iter(changed))} cannot be chosen"),
    ):
        source.plans(Options(**changed))


@pytest.mark.parametrize("topic", CARRIERS)
def test_missing_messages_are_found(topic, exported, tmp_path):
    def drop_first(name, number, raw):
        return [] if (name, number) == (topic, 0) else [raw]

    path = rewrite(exported[0], tmp_path / "cut", drop_first)
    with pytest.raises(RecordingError, match=r"cut: .*(expected|missing|describes no sequence)"):
        blocks_of(path)


@pytest.mark.parametrize("topic", CARRIERS)
def test_messages_that_come_twice_are_found(topic, exported, tmp_path):
    def double_first(name, number, raw):
        return [raw, raw] if (name, number) == (topic, 0) else [raw]

    path = rewrite(exported[0], tmp_path / "doubled", double_first)
    with pytest.raises(RecordingError, match=r"doubled: .*(expected|describes no sequence)"):
        blocks_of(path)


def test_nothing_is_written_of_an_export_that_is_not_whole(exported, tmp_path):
    path = rewrite(
        exported[0],
        tmp_path / "cut",
        lambda name, number, raw: [] if (name, number) == ("/scan", 5) else [raw],
    )
    with pytest.raises(RecordingError, match="/scan: expected 6 rows of .*, found 5"):
        import_export(path, tmp_path / "b.h5")
    assert not list(tmp_path.glob("*b.h5*"))


@pytest.mark.parametrize("topic", CARRIERS)
def test_changed_values_are_found(topic, exported, tmp_path):
    def flip_a_value(name, number, raw):
        if (name, number) != (topic, 0):
            return [raw]
        if topic == "/scan/labels":
            cloud = STORE.deserialize_cdr(raw, CLOUD)
            cloud.data = cloud.data.copy()
            cloud.data[20] ^= 1  # the label of the first point
            return [bytes(STORE.serialize_cdr(cloud, CLOUD))]
        at = len(raw) - 6  # among the values of each other type
        return [raw[:at] + bytes([raw[at] ^ 1]) + raw[at + 1 :]]

    path = rewrite(exported[0], tmp_path / "changed", flip_a_value)
    with pytest.raises(RecordingError, match="is not what was exported|describes no sequence"):
        blocks_of(path)


def test_scans_out_of_order_are_found(exported, tmp_path):
    kept = []

    def swap_the_first_two(name, number, raw):
        if name != "/scan" or number > 1:
            return [raw]
        kept.append(raw)
        return kept[::-1] if number == 1 else []

    path = rewrite(exported[0], tmp_path / "swapped", swap_the_first_two)
    with pytest.raises(RecordingError, match="is not what was exported"):
        blocks_of(path)


@pytest.mark.parametrize("topic", [SEQUENCE_TOPIC, END_TOPIC])
@pytest.mark.parametrize("copies", [0, 2])
def test_an_export_without_one_head_and_one_end_is_not_whole(topic, copies, exported, tmp_path):
    path = rewrite(
        exported[0], tmp_path / "cut", lambda name, _, raw: [raw] * (copies if name == topic else 1)
    )
    with pytest.raises(RecordingError, match=f"{topic}: expected one message, found {copies}"):
        blocks_of(path)


def head_of(path):
    with Bag(path) as bag:
        (message,) = bag.messages(t for t in bag.topics if t.name == SEQUENCE_TOPIC)
        return bag.read(message, lambda m: json.loads(m.data))


def with_head(exported, folder, head):
    """Copy the export with another head, and an end that fits it."""
    text = head if isinstance(head, str) else json.dumps(head)

    def change(name, _, raw):
        if name == SEQUENCE_TOPIC:
            return [said(text)]
        if name != END_TOPIC:
            return [raw]
        end = json.loads(STORE.deserialize_cdr(raw, STRING).data)
        end["head"] = hashlib.sha256(text.encode()).hexdigest()
        return [said(json.dumps(end))]

    return rewrite(exported[0], folder, change)


def test_a_changed_head_is_found(exported, tmp_path):
    path = rewrite(
        exported[0],
        tmp_path / "changed",
        lambda name, _, raw: [raw.replace(b"0.7]", b"0.8]") if name == SEQUENCE_TOPIC else raw],
    )
    with pytest.raises(RecordingError, match=f"{SEQUENCE_TOPIC}: is not what was exported"):
        blocks_of(path)


@pytest.mark.parametrize(
    ("where", "value"),
    [
        (("lidar", "beams"), 1),
        (("lidar", "beams"), 24),
        (("lidar", "colour"), "red"),
        (("lidar",), None),
        (("taxonomy", "names"), ["one"]),
        (("taxonomy", "colours"), 5),
        (("environment",), "Not A Slug"),
        (("environment",), 5),
        (("stamps_source",), "sundial"),
        (("map", "resolution"), -1.0),
        (("map", "origin"), [0.0, 0.0]),
        (("span_ns",), [1]),
        (("arrays",), {}),
        (("arrays",), []),
        (("arrays", "../evil"), {"topic": "/scan", "dtype": "<f4", "shape": [1]}),
        (("arrays", "original/new"), {"topic": "/scan", "dtype": "<f4", "shape": [1]}),
        (("arrays", "scans/ranges", "dtype"), "<f8"),
        (("arrays", "scans/ranges", "dtype"), "O"),
        (("arrays", "scans/ranges", "shape"), [7, 23]),
        (("arrays", "scans/ranges", "shape"), [6, 22]),
        (("arrays", "scans/ranges", "shape"), [6, -23]),
        (("arrays", "scans/ranges", "shape"), [2**62, 23]),
        (("arrays", "scans/ranges", "topic"), "/elsewhere"),
        (("arrays", "poses/refined", "topic"), "/scan"),
        (("arrays", "poses/refined", "topic"), "/scan/labels"),
        (("arrays", "poses/refined", "topic"), "/map"),
    ],
)
def test_a_head_that_does_not_fit_is_refused(where, value, exported, tmp_path):
    head = head_of(exported[0])
    part = head
    for key in where[:-1]:
        part = part[key]
    part[where[-1]] = value
    with pytest.raises(RecordingError, match="odd: "):
        blocks_of(with_head(exported, tmp_path / "odd", head))


@pytest.mark.parametrize("head", ["", "[]", "5", "{", '{"version": NaN}', "{}", "[" * 100_000])
def test_a_head_that_is_no_description_is_refused(head, exported, tmp_path):
    with pytest.raises(RecordingError, match="odd: "):
        blocks_of(with_head(exported, tmp_path / "odd", head))


def test_an_export_of_a_newer_version_is_refused(exported, tmp_path):
    head = head_of(exported[0]) | {"version": 2}
    with pytest.raises(RecordingError, match="expected an export of version 1, found 2; install"):
        blocks_of(with_head(exported, tmp_path / "new", head))


def test_flipped_bytes_are_refused_or_change_nothing(tmp_path):
    """The MCAP has no checksums of its own here: the digests in it find what is wrong."""
    random = np.random.default_rng(9)
    names = ("scans/ranges", "scans/stamps_ns", "scans/intensities")
    arrays = {name: array for name, array in full_arrays(random).items() if name in names}
    write_sequence(tmp_path / "a.h5", arrays)
    export_mcap(tmp_path / "a.h5", tmp_path / "a.mcap")
    whole, expected = (tmp_path / "a.mcap").read_bytes(), bits(arrays)
    refused = 0
    for number, at in enumerate(random.integers(0, len(whole), 80)):
        flipped = tmp_path / f"{number}.mcap"
        value = whole[at] ^ int(random.integers(1, 256))
        flipped.write_bytes(whole[:at] + bytes([value]) + whole[at + 1 :])
        try:
            assert bits(blocks_of(flipped)) == expected
        except RecordingError:
            refused += 1
    assert refused > 20  # the rest lie where nothing is said: in names, indexes, padding


def test_truncated_exports_are_refused(exported, tmp_path):
    whole = exported[0].read_bytes()
    for number, share in enumerate(np.linspace(0.01, 0.999, 7)):
        cut = tmp_path / f"{number}.mcap"
        cut.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(RecordingError):
            blocks_of(cut)
