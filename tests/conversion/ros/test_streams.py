"""Other topics of a bag, kept as arrays."""

import io
import json
import zipfile
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg

from conversion.ros.bags import Bag
from conversion.ros.streams import choose_streams, read_streams
from semantic2d_dataset.errors import RecordingError
from semantic2d_dataset.format.sequence import SequenceHeader, SequenceReader, SequenceWriter
from tests.conversion.detections import FOXY, HUMBLE, NOETIC, detection_drive
from tests.conversion.recordings import KINDS, ODOMETRY, POSE, START_NS, Recording
from tests.generators import SMALL_LIDAR, make_arrays

SECOND = 1_000_000_000
EVER = (0, 2**63 - 1)
PERSONS = "leg_tracker/msg/PersonArray"
PERSON = """std_msgs/Header header
string note
leg_tracker/Person[] people
{line}
MSG: leg_tracker/Person
geometry_msgs/Pose pose
uint32 id
string name
""".format(line="=" * 80)


def read(path, names, window=EVER):
    """All rows of the streams, by path, joined."""
    found: dict[str, list[np.ndarray]] = {}
    with Bag(path) as bag:
        for arrays in read_streams(bag, names, *window):
            for name, rows in arrays.items():
                found.setdefault(name, []).append(rows)
    return {name: np.concatenate(rows) for name, rows in found.items()}


def about(arrays, name):
    return json.loads(arrays[f"streams/{name}/about"].tobytes())


def column(arrays, name, wanted):
    return arrays[f"streams/{name}/data"][:, about(arrays, name)["columns"].index(wanted)]


def twist(drive, vx, wz):
    zero = {"y": 0.0}
    linear = drive.new("geometry_msgs/msg/Vector3", x=vx, z=0.0, **zero)
    angular = drive.new("geometry_msgs/msg/Vector3", x=0.0, z=wz, **zero)
    return drive.new("geometry_msgs/msg/Twist", linear=linear, angular=angular)


def path_message(drive, ns, places):
    poses = [
        drive.new(POSE, header=drive.header(ns, "map"), pose=drive.pose(x, y, 0.0))
        for x, y in places
    ]
    return drive.new("nav_msgs/msg/Path", header=drive.header(ns, "map"), poses=poses)


def image(drive, pixels, encoding, *, padding=0, big=False, step=None):
    height, width = pixels.shape[:2]
    stored = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
    rows = np.frombuffer(stored.tobytes(), np.uint8).reshape(height, -1)
    data = np.pad(rows, ((0, 0), (0, padding)))
    return drive.new(
        "sensor_msgs/msg/Image",
        header=drive.header(START_NS, "camera"),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(big),
        step=data.shape[1] if step is None else step,
        data=data.reshape(-1).copy(),
    )


def people_drive(kind, crowds):
    """Each crowd is a list of (x, y, id)."""
    drive = Recording(kind)
    drive.store.register(get_types_from_msg(PERSON, PERSONS))
    for n, crowd in enumerate(crowds):
        ns = START_NS + n * SECOND
        people = [
            drive.new(
                "leg_tracker/msg/Person", pose=drive.pose(x, y, 0.0), id=number, name="somebody"
            )
            for x, y, number in crowd
        ]
        message = drive.new(PERSONS, header=drive.header(ns + 5, "/odom"), note="", people=people)
        drive.add("/people", message, ns)
    return drive


@pytest.mark.parametrize("kind", KINDS)
def test_odometry_is_kept_with_its_own_stamps_and_all_its_numbers(kind, tmp_path):
    drive = Recording(kind)
    for n in range(3):
        ns = START_NS + n * SECOND
        drive.add_pose(
            ns, (n, 2.0, 0.3), topic="/odom", type_=ODOMETRY, frame="/odom", record_ns=ns + 7
        )
    arrays = read(drive.write(tmp_path), ["odom"])
    assert set(arrays) == {f"streams/odom/{name}" for name in ("stamps_ns", "data", "about")}
    assert arrays["streams/odom/stamps_ns"].tolist() == [START_NS + n * SECOND for n in range(3)]
    assert arrays["streams/odom/data"].shape == (3, 7 + 36 + 6 + 36)
    assert column(arrays, "odom", "pose.pose.position.x").tolist() == [0, 1, 2]
    assert column(arrays, "odom", "pose.pose.orientation.w")[0] == pytest.approx(np.cos(0.15))
    said = about(arrays, "odom")
    assert (said["topic"], said["type"]) == ("/odom", ODOMETRY)
    assert (said["stamps"], said["frames"]) == ("header", ["odom"])
    assert said["left_out"] == ["child_frame_id"]


@pytest.mark.parametrize("kind", KINDS)
def test_commands_without_a_header_get_their_times_of_recording(kind, tmp_path):
    drive = Recording(kind)
    drive.add("/cmd_vel", twist(drive, 0.5, -0.25), START_NS + 3)
    stamped = drive.new(
        "geometry_msgs/msg/TwistStamped",
        header=drive.header(START_NS + 1, "base_link"),
        twist=twist(drive, 0.75, 0.0),
    )
    drive.add("/stamped", stamped, START_NS + 4)
    arrays = read(drive.write(tmp_path), ["/cmd_vel", "/stamped"])
    assert arrays["streams/cmd-vel/stamps_ns"].tolist() == [START_NS + 3]
    assert arrays["streams/cmd-vel/data"].tolist() == [[0.5, 0, 0, 0, 0, -0.25]]
    assert about(arrays, "cmd-vel")["stamps"] == "record"
    assert about(arrays, "cmd-vel")["columns"][0] == "linear.x"
    assert arrays["streams/stamped/stamps_ns"].tolist() == [START_NS + 1]
    assert column(arrays, "stamped", "twist.linear.x").tolist() == [0.75]


def test_imu_and_pose_arrays_are_kept(tmp_path):
    drive = Recording("mcap")
    vector = drive.new("geometry_msgs/msg/Vector3", x=1.0, y=2.0, z=3.0)
    nines = {
        f"{name}_covariance": np.arange(9.0)
        for name in ("orientation", "angular_velocity", "linear_acceleration")
    }
    imu = drive.new(
        "sensor_msgs/msg/Imu",
        header=drive.header(START_NS, "imu"),
        orientation=drive.turn(0.0, 0.0, 0.0),
        angular_velocity=vector,
        linear_acceleration=vector,
        **nines,
    )
    drive.add("/imu", imu, START_NS)
    poses = [drive.pose(x, 0.0, 0.0) for x in (4.0, 5.0)]
    header = drive.header(START_NS, "map")
    drive.add(
        "/crowd", drive.new("geometry_msgs/msg/PoseArray", header=header, poses=poses), START_NS
    )
    arrays = read(drive.write(tmp_path), ["all"])
    assert arrays["streams/imu/data"].shape == (1, 4 + 9 + 3 + 9 + 3 + 9)
    assert column(arrays, "imu", "linear_acceleration.z").tolist() == [3]
    assert column(arrays, "imu", "orientation_covariance[8]").tolist() == [8]
    assert column(arrays, "crowd", "position.x").tolist() == [4, 5]
    assert arrays["streams/crowd/offsets"].tolist() == [0, 2]


@pytest.mark.parametrize("kind", KINDS)
def test_plans_keep_their_lengths(kind, tmp_path):
    drive = Recording(kind)
    plans = [[(0, 1), (1, 1), (2, 3)], [], [(5, 5)]]
    for n, places in enumerate(plans):
        ns = START_NS + n
        drive.add("/move_base/plan", path_message(drive, ns, places), ns)
    arrays = read(drive.write(tmp_path), ["move_base/plan"])
    assert arrays["streams/move-base-plan/offsets"].tolist() == [0, 3, 3, 4]
    assert arrays["streams/move-base-plan/data"].shape == (4, 7)
    assert column(arrays, "move-base-plan", "pose.position.x").tolist() == [0, 1, 2, 5]
    assert about(arrays, "move-base-plan")["left_out"] == ["poses.header"]


@pytest.mark.parametrize("kind", KINDS)
def test_people_of_a_type_that_only_the_bag_knows_are_kept(kind, tmp_path):
    crowds = [[], [(1.0, 2.0, 7), (3.0, 4.0, 8)], [(5.0, 6.0, 7)]]
    arrays = read(people_drive(kind, crowds).write(tmp_path), ["people"])
    assert arrays["streams/people/offsets"].tolist() == [0, 0, 2, 3]
    assert column(arrays, "people", "pose.position.y").tolist() == [2, 4, 6]
    assert column(arrays, "people", "id").tolist() == [7, 8, 7]
    said = about(arrays, "people")
    assert said["left_out"] == ["note"]
    assert (said["frames"], said["stamps"]) == (["odom"], "header")
    assert said["words"] == {"name": ["somebody"]}
    assert column(arrays, "people", "name").tolist() == [0, 0, 0]


def named_drive(kind, names):
    """One message; a person of each name."""
    drive = people_drive(kind, [[(0.0, 0.0, 7)] * len(names)])
    for person, name in zip(drive.messages[0][3].people, names, strict=True):
        person.name = name
    return drive


@settings(max_examples=8)
@given(names=st.lists(st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"))))
def test_every_text_comes_back_by_its_number(names, tmp_path_factory):
    path = named_drive("mcap", names).write(tmp_path_factory.mktemp("names"))
    arrays = read(path, ["people"])
    words, codes = about(arrays, "people")["words"]["name"], column(arrays, "people", "name")
    assert [words[int(code)] for code in codes] == names
    assert len(set(words)) == len(words)


def test_texts_beyond_what_a_file_can_say_have_no_number_and_the_others_keep_theirs(tmp_path):
    long = [f"{n}" * (1 << 18) for n in range(6)]
    arrays = read(named_drive("mcap", ["ann", *long, "ann", "bob"]).write(tmp_path), ["people"])
    codes = column(arrays, "people", "name").tolist()
    assert codes == [0, 1, 2, 3, -1, -1, -1, 0, 4]
    assert about(arrays, "people")["words"]["name"] == ["ann", *long[:3], "bob"]
    assert arrays["streams/people/about"].nbytes < 1 << 24


@pytest.mark.parametrize(
    ("kind", "definition", "names", "where", "what", "score", "tracks"),
    [
        ("ros1", NOETIC, (18, 1), "bbox.center.", "results.id", "results.score", None),
        (
            "db3",
            FOXY,
            ("dog", "person"),
            "bbox.center.",
            "results.id",
            "results.score",
            "tracking_id",
        ),
        (
            "mcap",
            HUMBLE,
            ("dog", "person"),
            "bbox.center.position.",
            "results.hypothesis.class_id",
            "results.hypothesis.score",
            "id",
        ),
    ],
)
def test_detections_keep_their_boxes_and_their_best_class(
    kind, definition, names, where, what, score, tracks, tmp_path
):
    dog, person = names
    frames = [
        [(10.0, 20.0, 4.0, 6.0, {person: 0.25, dog: 0.75}), (30.0, 40.0, 5.0, 7.0, {person: 0.5})],
        [],
        [(50.0, 60.0, 2.0, 3.0, {})],
    ]
    arrays = read(detection_drive(kind, definition, frames).write(tmp_path), ["detections"])
    assert arrays["streams/detections/offsets"].tolist() == [0, 2, 2, 3]
    stamps = [START_NS + n * SECOND for n in range(3)]
    assert arrays["streams/detections/stamps_ns"].tolist() == stamps
    for name, wanted in (
        (f"{where}x", [10, 30, 50]),
        (f"{where}y", [20, 40, 60]),
        ("bbox.size_x", [4, 5, 2]),
        ("bbox.size_y", [6, 7, 3]),
        (score, [0.75, 0.5, np.nan]),
    ):
        np.testing.assert_array_equal(column(arrays, "detections", name), wanted)
    said, found = about(arrays, "detections"), column(arrays, "detections", what)
    assert said["best_of"] == ["results"]
    assert np.isnan(found[2])
    if what in said.get("words", ()):
        assert [said["words"][what][int(code)] for code in found[:2]] == [dog, person]
    else:
        assert found[:2].tolist() == [dog, person]
    if tracks:
        assert said["words"][tracks] == ["t1"]
    assert "detections.results" not in said["left_out"]


@settings(max_examples=8)
@given(
    crowds=st.lists(
        st.lists(
            st.tuples(st.floats(allow_nan=True, width=64), st.floats(), st.integers(0, 2**32 - 1)),
            max_size=4,
        ),
        min_size=1,
        max_size=6,
    )
)
def test_every_crowd_comes_back_by_its_offsets(crowds, tmp_path_factory):
    path = people_drive("mcap", crowds).write(tmp_path_factory.mktemp("crowds"))
    arrays = read(path, ["people"])
    offsets = arrays["streams/people/offsets"]
    x, y, number = (
        column(arrays, "people", name) for name in ("pose.position.x", "pose.position.y", "id")
    )
    found = [list(zip(x[a:b], y[a:b], number[a:b], strict=True)) for a, b in pairwise(offsets)]
    np.testing.assert_equal(found, [[tuple(person) for person in crowd] for crowd in crowds])


@pytest.mark.parametrize("kind", KINDS)
def test_compressed_images_keep_their_bytes(kind, tmp_path):
    drive = Recording(kind)
    sent = [bytes([255, 216, n, 1]) * (n + 1) for n in range(3)]
    for n, data in enumerate(sent):
        message = compressed_image(drive, START_NS + n, data)
        drive.add("/camera/image/compressed", message, START_NS + n)
    arrays = read(drive.write(tmp_path), ["/camera/image/compressed"])
    name = "streams/camera-image-compressed"
    ends = arrays[f"{name}/offsets"].tolist()
    data = arrays[f"{name}/data"]
    assert data.dtype == np.uint8
    assert [data[a:b].tobytes() for a, b in pairwise(ends)] == sent
    assert about(arrays, "camera-image-compressed")["formats"] == ["jpeg"]


RANDOM = np.random.default_rng(5)
BYTES = RANDOM.integers(0, 256, (5, 4, 4), np.uint8)
WORDS = RANDOM.integers(0, 65536, (5, 4), np.uint16)
FLOATS = np.array([[0.5, np.nan, np.inf], [-np.inf, -0.0, 1e-42]], np.float32)


@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize(
    ("encoding", "pixels", "shown"),
    [
        ("mono8", BYTES[..., 0], BYTES[..., 0]),
        ("rgb8", BYTES[..., :3], BYTES[..., :3]),
        ("bgr8", BYTES[..., :3], BYTES[..., 2::-1]),
        ("rgba8", BYTES, BYTES),
        ("bgra8", BYTES, BYTES[..., [2, 1, 0, 3]]),
        ("bayer_rggb8", BYTES[..., 1], BYTES[..., 1]),
        ("16UC1", WORDS, WORDS),
        ("32FC1", FLOATS, FLOATS),
    ],
)
def test_raw_images_are_encoded_without_loss(encoding, pixels, shown, padding, tmp_path):
    drive = Recording("ros1")
    for big in (False, True):
        drive.add("/depth", image(drive, pixels, encoding, padding=padding, big=big), START_NS)
    arrays = read(drive.write(tmp_path), ["depth"])
    ends = arrays["streams/depth/offsets"].tolist()
    for a, b in pairwise(ends):
        with Image.open(io.BytesIO(arrays["streams/depth/data"][a:b].tobytes())) as decoded:
            found = np.asarray(decoded).astype(shown.dtype)
        assert found.tobytes() == np.ascontiguousarray(shown).tobytes()
    kind = "tiff" if encoding == "32FC1" else "png"
    assert about(arrays, "depth")["formats"] == [f"{kind} of {encoding}"]


def test_images_that_cannot_be_encoded_are_refused_with_their_reason(tmp_path):
    drive = Recording("mcap")
    drive.add("/yuv", image(drive, BYTES[..., :2], "yuv422"), START_NS)
    drive.add("/short", image(drive, BYTES[..., 0], "rgb8"), START_NS)
    drive.add("/torn", image(drive, BYTES[..., 0], "mono8", step=3), START_NS)
    path = drive.write(tmp_path)
    with pytest.raises(RecordingError, match=r"/yuv: .*'yuv422' cannot be kept.*bgr8.*32FC1"):
        read(path, ["yuv"])
    with pytest.raises(RecordingError, match=r"/short: .*4 bytes a row for 4 pixels of rgb8"):
        read(path, ["short"])
    with pytest.raises(RecordingError, match=r"/torn: the message at .* is no readable"):
        read(path, ["torn"])


def mixed_drive(kind="mcap"):
    drive = Recording(kind)
    drive.add_scan(START_NS, [1.0] * 8)
    drive.add_tf(START_NS, "map", "odom", (0, 0, 0))
    drive.add("/cmd_vel", twist(drive, 1.0, 0.0), START_NS)
    drive.add("/camera", image(drive, BYTES[..., 0], "mono8"), START_NS)
    drive.add("/chat", drive.new("std_msgs/msg/String", data="hello"), START_NS)
    drive.add_pose(START_NS, (1, 2, 0), topic="/goal", type_=POSE)
    return drive


@pytest.mark.parametrize("kind", KINDS)
def test_all_keeps_every_topic_that_can_be_but_images_only_by_name(kind, tmp_path):
    path = mixed_drive(kind).write(tmp_path)
    with Bag(path) as bag:
        assert [s.name for s in choose_streams(bag, ["all"])] == ["cmd-vel", "goal"]
        assert [s.name for s in choose_streams(bag, ["all", "/camera"])] == [
            "camera",
            "cmd-vel",
            "goal",
        ]
        assert choose_streams(bag, ()) == ()
        assert list(read_streams(bag, (), *EVER)) == []


def test_a_topic_that_cannot_be_kept_is_refused_with_those_that_can(tmp_path):
    with Bag(mixed_drive().write(tmp_path)) as bag:
        able = r"/camera \(sensor_msgs/msg/Image\), /cmd_vel \(geometry_msgs/msg/Twist\), /goal"
        for name, why in [
            ("gps", "no topic 'gps'"),
            ("/scan", "/scan is of type sensor_msgs/msg/LaserScan, which cannot be kept"),
            ("/tf", "/tf is of type tf2_msgs/msg/TFMessage"),
            ("chat", "chat is of type std_msgs/msg/String"),
        ]:
            with pytest.raises(RecordingError, match=f"{why}.*: {able}"):
                read_streams(bag, [name], *EVER)


def test_only_what_was_recorded_in_the_time_is_kept_ends_included(tmp_path):
    drive = Recording("db3")
    for n in range(6):
        drive.add("/cmd_vel", twist(drive, float(n), 0.0), START_NS + n)
    path = drive.write(tmp_path)
    arrays = read(path, ["cmd_vel"], (START_NS + 2, START_NS + 4))
    assert column(arrays, "cmd-vel", "linear.x").tolist() == [2, 3, 4]
    late = read(path, ["cmd_vel"], (START_NS + 10, START_NS + 20))
    assert late["streams/cmd-vel/data"].shape == (0, 6)
    assert about(late, "cmd-vel")["type"] == "geometry_msgs/msg/Twist"
    assert read(path, ["cmd_vel"], (-5, START_NS))["streams/cmd-vel/stamps_ns"].size == 1


def test_topics_whose_names_become_the_same_stay_apart(tmp_path):
    drive = Recording("ros1")
    for topic, vx in (("/a/b", 1.0), ("/a_b", 2.0)):
        drive.add(topic, twist(drive, vx, 0.0), START_NS)
    arrays = read(drive.write(tmp_path), ["all"])
    assert column(arrays, "a-b", "linear.x").tolist() == [1]
    assert column(arrays, "a-b-2", "linear.x").tolist() == [2]
    assert about(arrays, "a-b-2")["topic"] == "/a_b"


def compressed_image(drive, ns, data):
    return drive.new(
        "sensor_msgs/msg/CompressedImage",
        header=drive.header(ns, "camera"),
        format="jpeg",
        data=np.frombuffer(data, np.uint8),
    )


def test_blocks_are_bounded_whatever_the_length(tmp_path):
    drive = Recording("mcap")
    size = 400_000
    for n in range(10):
        ns = START_NS + n
        drive.add("/jpeg", compressed_image(drive, ns, bytes([n]) * size), ns)
    with Bag(drive.write(tmp_path)) as bag:
        blocks = list(read_streams(bag, ["jpeg"], *EVER))
    assert [len(block["streams/jpeg/stamps_ns"]) for block in blocks] == [3, 3, 3, 1]
    offsets = np.concatenate([block["streams/jpeg/offsets"] for block in blocks])
    np.testing.assert_array_equal(offsets, np.arange(11) * size)


def test_a_definition_that_cannot_be_read_only_costs_its_own_topic(tmp_path):
    store = Recording("mcap").store
    with Writer(tmp_path / "odd", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        writer.add_connection("/odd", "my/msg/Odd", msgdef="this is ] no definition", rihs01="x")
        loop = "my/Loop[2] parts\nmy/Loop part"
        writer.add_connection("/loop", "my/msg/Loop", msgdef=loop, rihs01="y")
        doubling = [f"MSG: my/D{n}\nmy/D{n + 1} a\nmy/D{n + 1} b" for n in range(30)]
        parts = ["my/D0 a", *doubling, "MSG: my/D30\nfloat64 x"]
        deep = f"\n{'=' * 80}\n".join(parts)
        writer.add_connection("/deep", "my/msg/Deep", msgdef=deep, rihs01="z")
        good = writer.add_connection("/cmd_vel", "geometry_msgs/msg/Twist", typestore=store)
        message = twist(Recording("mcap"), 1.0, 0.0)
        writer.write(good, START_NS, store.serialize_cdr(message, good.msgtype))
    with Bag(tmp_path / "odd") as bag:
        assert [s.name for s in choose_streams(bag, ["all"])] == ["cmd-vel"]
        with pytest.raises(RecordingError, match="/odd is of type my/msg/Odd, which cannot"):
            choose_streams(bag, ["/odd"])


def test_a_sequence_holds_its_streams_and_its_digest_covers_them(tmp_path):
    path = people_drive("db3", [[(1.0, 2.0, 7)], []]).write(tmp_path)
    digests = []
    for n, names in enumerate((["people"], ["people"], [])):
        header = SequenceHeader(environment="lab", recording="one", lidar=SMALL_LIDAR)
        with SequenceWriter(tmp_path / f"{n}.h5", header) as writer, Bag(path) as bag:
            writer.append(make_arrays(3))
            for arrays in read_streams(bag, names, *EVER):
                if n == 1:
                    said = json.loads(arrays["streams/people/about"].tobytes())
                    text = json.dumps(said | {"frames": ["elsewhere"]}).encode()
                    arrays["streams/people/about"] = np.frombuffer(text, np.uint8)
                writer.append(arrays)
        with SequenceReader(tmp_path / f"{n}.h5") as reader:
            digests.append(reader.content_digest())
            if n == 0:
                assert reader.describe_stream("people")["topic"] == "/people"
                assert reader.read("streams/people/offsets").tolist() == [0, 1, 1]
    assert len(set(digests)) == 3


def test_people_of_a_real_recording_are_kept(shared_data, tmp_path):
    archive = shared_data / "leg_tracker_benchmarks" / "general_tracking_moving_1.bag.zip"
    path = tmp_path / "people.bag"
    with zipfile.ZipFile(archive) as packed:
        path.write_bytes(packed.read(packed.namelist()[0]))
    arrays = read(path, ["ground_truth_people_tracks"])
    assert arrays["streams/ground-truth-people-tracks/data"].shape == (153, 8)
    assert np.isfinite(column(arrays, "ground-truth-people-tracks", "pose.position.x")).all()
    assert about(arrays, "ground-truth-people-tracks")["type"] == "leg_tracker/msg/Person"
