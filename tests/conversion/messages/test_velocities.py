from __future__ import annotations

import numpy as np
import pytest

from conversion.messages.source import MessageSource
from conversion.messages.velocities import VelocityLog
from conversion.options import Options
from conversion.ros.bags import Bag
from conversion.ros.recording import RosRecording
from semantic2d_dataset.errors import RecordingError
from tests.conversion.recordings import KINDS, START_NS, straight_drive

TENTH = 100_000_000
TWIST = "geometry_msgs/msg/Twist"


def vector(drive, x=0.0, z=0.0):
    return drive.new("geometry_msgs/msg/Vector3", x=x, y=0.0, z=z)


def commanded_drive(kind, folder, topics=("/bluetooth_teleop/cmd_vel",)):
    """A drive with a command at every other scan, 20 ms before it."""
    drive = straight_drive(kind)
    for topic in topics:
        for n in range(0, 12, 2):
            twist = drive.new(TWIST, linear=vector(drive, x=0.1 * n), angular=vector(drive, z=-0.2))
            drive.add(topic, twist, START_NS + n * TENTH + 30_000_000)
    drive.messages.sort(key=lambda message: message[2])
    return drive.write(folder)


def velocities(path, **options):
    with MessageSource(RosRecording(Bag(path))) as source:
        (plan,) = source.plans(Options(**options))
        (arrays,) = plan.blocks()
    return arrays.get("commands/velocity")


@pytest.mark.parametrize("kind", KINDS)
def test_each_scan_gets_the_command_in_force(kind, tmp_path):
    found = velocities(commanded_drive(kind, tmp_path))
    expected = [0.1 * (n - n % 2) for n in range(12)]
    np.testing.assert_allclose(found, np.column_stack((expected, [-0.2] * 12)))


def test_commands_can_be_left_out_or_named(tmp_path):
    path = commanded_drive("db3", tmp_path, ("/cmd_vel", "/teleop"))
    assert velocities(path, velocity="none") is None
    np.testing.assert_allclose(velocities(path, velocity="teleop")[:, 1], -0.2)
    with pytest.raises(RecordingError, match="no topic '/joy' .* there are: /cmd_vel, /teleop"):
        velocities(path, velocity="/joy")


def test_without_commands_the_sequence_has_none(tmp_path):
    assert velocities(straight_drive("ros1").write(tmp_path)) is None


def test_a_command_holds_for_a_second():
    log = VelocityLog(None)
    log.add(5 * TENTH, 1.0, 2.0)
    found = log.at(np.array([0, 5, 14, 15, 16]) * TENTH)
    np.testing.assert_array_equal(found[:, 0], [np.nan, 1.0, 1.0, 1.0, np.nan])
    assert np.isnan(VelocityLog(None).at(np.array([3]))).all()
