import numpy as np
import pytest

from salsa.fields import map_field
from salsa.labelling import transfer_labels
from salsa.persistence import HitCounter, Persistence
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D
from tests.salsa import rooms

BIN = (5.1, 2.4, 5.4, 2.7)
PERSON_ID = SEMANTIC2D.id_of("Person")


def recording(boxes, seconds):
    """Scans of a robot at rest, one for each box that stands there then, over some seconds."""
    pose = rooms.true_poses(2)[:1].repeat(len(boxes), axis=0)
    scans = [rooms.batch_at(pose[:1], pose[:1], extra=[box], noise=0.0) for box in boxes]
    ranges = np.concatenate([scan.ranges for scan in scans])
    stamps = np.linspace(0, seconds, len(boxes)) * 1e9
    batch = type(scans[0])(
        rooms.LIDAR, ranges, None, None, pose, stamps.astype(np.int64) + 1_700_000_000 * 10**9
    )
    return batch, pose


def people_after(batch, poses, persistence):
    field = map_field(rooms.room_map())
    accepted = np.ones(len(batch), bool)
    counter = HitCounter(field, 0.15)
    counter.add(batch, poses, accepted)
    reduced, cells = counter.without_static(persistence)
    before, _ = transfer_labels(batch, poses, field, accepted)
    after, _ = transfer_labels(batch, poses, reduced, accepted)
    return (before == PERSON_ID).sum(), (after == PERSON_ID).sum(), (after == 0).sum(), cells


def test_a_thing_that_stays_is_no_person():
    before, after, other, cells = people_after(
        *recording([BIN] * 120, seconds=60), Persistence(min_seconds=20, min_hits=50)
    )
    assert before > 1000
    assert after == 0
    assert other >= before
    assert cells > 3


def test_a_person_who_walks_by_or_stays_shortly_remains_one():
    limits = Persistence(min_seconds=20, min_hits=50)
    steps = np.linspace(0.0, 1.5, 120)
    walk = [(4.0 + dx, 2.9, 4.3 + dx, 3.1) for dx in steps]
    for boxes, seconds in ((walk, 60), ([BIN] * 120, 15)):
        before, after, _, cells = people_after(*recording(boxes, seconds), limits)
        assert before == after > 1000
        assert cells == 0


def test_scans_that_are_not_accepted_do_not_count():
    batch, poses = recording([BIN] * 120, seconds=60)
    counter = HitCounter(map_field(rooms.room_map()), 0.15)
    counter.add(batch, poses, np.zeros(120, bool))
    assert counter.without_static(Persistence())[1] == 0


def test_limits_below_one_are_refused():
    with pytest.raises(InvalidInputError, match="persistence"):
        Persistence(min_seconds=0)
