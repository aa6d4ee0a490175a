import numpy as np
import pytest

from salsa.inspection import Inspection, check_labelled, coverage, inspect_sequence
from salsa.pictures import Sheet
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from tests.generators import make_sequence
from tests.salsa import rooms
from tests.salsa.conftest import BLIND, LOST, SCANS


def inspect(path):
    with SequenceReader(path) as reader:
        scene = check_labelled(reader)
        return inspect_sequence(reader, scene, Sheet.over(scene)), scene


def test_the_worst_come_first_and_who_has_no_pose_never(labelled_room):
    found, _ = inspect(labelled_room)
    assert set(found.worst(4).tolist()) == set(BLIND)
    assert LOST not in found.worst(SCANS)
    assert (np.diff(found.badness[found.worst(SCANS)]) <= 0).all()
    assert np.nanmin(found.badness) >= 0
    assert np.nanmax(found.badness) <= 5
    assert len(found.worst(12)) == 12


def test_of_a_long_bad_stretch_only_the_worst_is_shown(tmp_path):
    found = np.zeros(1000)
    found[100:105] = (1, 2, 5, 2, 1)
    found[700] = 3
    one = object.__new__(Inspection)
    one.__dict__.update(badness=found, seconds=found)
    assert one.worst(2).tolist() == [102, 700]


def test_coverage_tells_what_was_met(labelled_room):
    found, scene = inspect(labelled_room)
    met = coverage(found, scene)
    assert set(met) == {SEMANTIC2D.id_of(name) for name in rooms.BOXES}
    sofa, wall = met[SEMANTIC2D.id_of("Sofa")], met[SEMANTIC2D.id_of("Wall")]
    assert sofa[0] == (scene.labels == SEMANTIC2D.id_of("Sofa")).sum()
    assert 0.3 < sofa[1] < 0.9  # two of its sides are behind it
    assert wall[1] > 0.5
    found.hit[:] = False
    assert coverage(found, scene)[SEMANTIC2D.id_of("Wall")][1] == 0.0


def test_figures_are_those_of_the_file(labelled_room):
    found, _ = inspect(labelled_room)
    with SequenceReader(labelled_room) as reader:
        batch, confidence = reader.batch(), reader.read("scans/confidence")
        refined, rough = reader.read("poses/refined"), reader.read("poses/initial")
    assert np.flatnonzero(~found.known).tolist() == [LOST]
    assert np.flatnonzero(found.known & ~found.accepted).tolist() == list(BLIND)
    np.testing.assert_array_equal(
        found.counts, np.bincount(batch.labels[batch.valid], minlength=256)
    )
    assert found.confidence[30] == pytest.approx(confidence[30][batch.valid[30]].mean() / 255)
    assert found.seconds[30] == pytest.approx(1.5)
    moved = (refined - rough)[:, :2]
    assert found.jump_m[30] == pytest.approx(np.hypot(*(moved[30] - moved[29])))
    assert np.isnan(found.jump_m[[0, LOST, LOST + 1]]).all()
    assert np.nanmedian(found.near_before) < 0.8 < np.nanmedian(found.inlier_ratio)


def test_a_sequence_without_a_map_or_scans_is_refused(tmp_path, labelled_room):
    make_sequence(tmp_path / "bare.h5", 3, drop=("scans/labels",))
    with (
        SequenceReader(tmp_path / "bare.h5") as reader,
        pytest.raises(InvalidInputError, match="has no scans/labels, .*label it first"),
    ):
        check_labelled(reader)
