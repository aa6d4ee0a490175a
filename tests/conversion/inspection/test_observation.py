"""One look at all messages of a recording."""

from conversion.inspection.observation import observe
from conversion.options import Options
from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from tests.conversion.inspection.test_inspection import TENTH, office
from tests.conversion.recordings import LASER, START_NS, STRING


def look(path):
    with RosRecording(Bag(path)) as recording:
        return observe(recording, Options())


def test_every_message_is_timed_and_only_what_is_understood_is_decoded(tmp_path):
    drive = office()
    for n in range(7):
        drive.add("/chatter", drive.new(STRING, data="x"), START_NS + n * TENTH)
    seen = look(drive.write(tmp_path))
    assert {name: len(line) for (name, _), line in seen.timelines.items()} == {
        "/amcl_pose": 4,
        "/chatter": 7,
        "/odom": 40,
        "/scan": 40,
    }
    assert (seen.first_ns, seen.last_ns) == (START_NS, START_NS + 39 * TENTH)
    assert set(seen.probes) == {"/scan"}
    assert set(seen.poses.tracks) == {"/amcl_pose", "/odom"}
    assert seen.unreadable == {}
    assert seen.damage is None


def test_a_topic_that_cannot_be_decoded_is_named_and_the_others_are_read(tmp_path):
    path = office().write(tmp_path)
    broken = path.read_bytes().replace(b"float32[] ranges", b"float64[] ranges")
    path.write_bytes(broken)
    seen = look(path)
    assert list(seen.unreadable) == [("/scan", LASER)]
    assert len(seen.timelines["/scan", LASER]) == 40
    assert len(seen.poses.tracks["/odom"]) == 40
    assert seen.survey.scans == ()


def test_damage_ends_the_look_and_keeps_what_was_seen(tmp_path):
    path = office(scans=400).write(tmp_path, compression="bz2", chunk=20_000)
    content = bytearray(path.read_bytes())
    middle = content.index(b"BZh", len(content) // 2) + 50
    content[middle : middle + 200] = bytes(200)
    path.write_bytes(content)
    seen = look(path)
    assert "damaged" in seen.damage
    assert seen.probes["/scan"].statistics.scans == len(seen.probes["/scan"].log) > 100
