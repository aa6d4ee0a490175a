"""What layouts of arrays hold."""

import json

import numpy as np
import pytest

from conversion.convert import convert_recording
from conversion.exports.mcap import export_mcap
from conversion.inspection.inspection import inspect_source
from conversion.layouts.ogm import OgmSource
from conversion.options import Options
from conversion.sources import open_source
from tests.conversion.recordings import straight_drive

SCANS = 12


@pytest.fixture
def layout(tmp_path):
    """Three sessions of OGM-Turtlebot2, in which a robot drives 1 m along x."""
    root = tmp_path / "OGM-Turtlebot2"
    random = np.random.default_rng(1)
    for split in ("train", "val", "test"):
        for kind in ("scans", "positions", "velocities"):
            (root / split / kind).mkdir(parents=True)
        for n in range(SCANS):
            rows = {
                "scans": np.where(random.random(1080) < 0.25, 30.0, random.uniform(1, 20, 1080)),
                "positions": np.array((n / (SCANS - 1), 0.0, 0.0)),
                "velocities": np.zeros(2),
            }
            for kind, row in rows.items():
                np.save(root / split / kind / f"{n:07d}.npy", row)
        names = "".join(f"{n:07d}.npy\n" for n in range(SCANS))
        (root / split / "scans" / f"{split}.txt").write_text(names)
    return root


def inspect(path):
    with OgmSource(path) as source:
        return inspect_source(source, Options())


def test_every_sequence_of_arrays_is_looked_at(layout):
    found = inspect(layout)
    assert len(found.plans) == len(found.scans) == len(found.poses) == 3
    assert found.problems == ()
    scans = found.scans[0]
    assert (scans.scans, scans.beams, scans.intensities.kind) == (SCANS, 1080, "none")
    assert scans.kinds["returns"] == pytest.approx(0.75, abs=0.02)
    assert scans.kinds["no return (+inf)"] == pytest.approx(0.25, abs=0.02)
    assert found.plans[0].lists


def test_poses_of_arrays_make_a_way(layout):
    found = inspect(layout)
    assert found.poses[0].coverage == {found.plans[0].sequence_id: 1.0}
    assert found.poses[0].length_m == pytest.approx(1)
    way = found.pictures.trajectories[found.plans[0].sequence_id]
    np.testing.assert_allclose(way[:, 0], np.linspace(0, 1, SCANS))


def test_arrays_without_stamps_have_no_times(layout):
    found = inspect(layout)
    assert (found.start, found.duration_s, found.scans[0].stamps) == (None, None, None)
    assert found.pictures.rates == {}
    assert [sample.ranges.shape for sample in found.pictures.samples[found.scans[0].topic]] == [
        (1080,)
    ] * 3


def test_arrays_are_plain_values_and_text_too(layout):
    found = inspect(layout)
    json.dumps(found.as_dict(), allow_nan=False)
    assert "turtlebot2-1080" in str(found)


def test_arrays_that_cannot_be_read_are_a_problem_and_no_error(layout):
    (layout / "val" / "scans" / "0000007.npy").write_bytes(b"no array")
    found = inspect(layout)
    assert len(found.problems) == 1
    assert "0000007.npy" in found.problems[0]


def test_sequences_with_stamps_have_times_and_rates(tmp_path):
    drive = straight_drive("mcap").write(tmp_path)
    convert_recording(drive, tmp_path / "drive.h5", Options(recording="drive"))
    export_mcap(tmp_path / "drive.h5", tmp_path / "exported")
    with open_source([tmp_path / "exported"], Options()) as source:
        found = inspect_source(source, Options())
    (topic,) = found.topics
    assert (topic.messages, topic.rate_hz) == (12, pytest.approx(10))
    assert found.duration_s == pytest.approx(1.1)
    assert found.start == "2023-11-14T22:13:20.050Z"
    edges, rates = found.pictures.rates[topic.name]
    assert (rates * np.diff(edges)).sum() == pytest.approx(12)
    assert found.scans[0].upside_down
