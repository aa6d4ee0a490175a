from dataclasses import replace

import numpy as np
import pytest

from salsa.evidence import Ledger, coarse, gather
from salsa.fields import map_field
from salsa.labelling import transfer_labels
from salsa.things import NO_THINGS, Persistence, find_things
from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.lidars import HOKUYO_UTM_30LX_EW
from semantic2d_dataset.scene.maps import FREE
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, UNLABELLED
from semantic2d_dataset.simulation.recording import simulate_recording
from semantic2d_dataset.simulation.worlds import draw_world, perturb
from tests.salsa import rooms
from tests.salsa.test_evidence import BOX, watch

OTHER, PERSON, TABLE = (SEMANTIC2D.id_of(name) for name in ("Other", "Person", "Table"))


def things_in(batch, scene=None, persistence=None):
    field = map_field(scene or rooms.room_map())
    accepted = np.ones(len(batch), bool)
    ledger = Ledger(coarse(field)[1]).add(gather(batch, batch.poses, accepted, field))
    found = find_things(ledger, field, 0.15, persistence or Persistence(), SEMANTIC2D)
    layer = found.layer(field.free.shape)
    labels, _ = transfer_labels(batch, batch.poses, field, accepted, things=layer)
    return found, labels


def test_a_box_that_stays_is_other():
    batch = watch(8, lambda _: [BOX])
    plain, _ = transfer_labels(batch, batch.poses, rooms.room_map(), np.ones(len(batch), bool))
    found, labels = things_in(batch)
    assert (plain == PERSON).sum() > 1000
    assert (labels == PERSON).sum() == 0
    assert (labels[plain == PERSON] == OTHER).all()
    assert (found.things, found.moved, found.standing) == (1, 0, 0)


def test_who_walks_by_stays_shortly_or_leaves_remains_a_person():
    def walking(t):
        return [(4.0 + 0.2 * t, 2.9, 4.3 + 0.2 * t, 3.1)]

    for batch in (watch(8, walking), watch(4, lambda _: [BOX])):
        found, labels = things_in(batch)
        assert (labels == PERSON).sum() > 500
        assert found.things == 0
    labels = things_in(watch(20, lambda t: [BOX] if t < 8 else []))[1]
    assert (labels == PERSON).sum() > 1000  # seen through for longer than it was there


def test_many_feet_one_after_the_other_are_no_thing():
    """A crowd meets a place in every look; nobody stays."""
    batch = watch(12, lambda t: [BOX] if t % 1 < 0.5 else [])
    found, labels = things_in(batch, persistence=Persistence(min_share=0.3))
    assert found.things == found.standing == 0
    assert (labels == PERSON).sum() > 1000


def test_a_mapped_object_that_was_moved_is_found_again():
    scene = rooms.room_map()
    old = (5.525, 2.225, 5.825, 2.525)  # a small table of the map, where now nothing is
    r1, c1, r2, c2 = rooms._cells(old)
    scene.occupancy[r1 : r2 + 1, c1 : c2 + 1] = 100
    scene.labels[r1 : r2 + 1, c1 : c2 + 1] = TABLE
    new = (5.3, 3.0, 5.6, 3.3)
    found, labels = things_in(watch(8, lambda _: [new]), scene)
    assert (found.things, found.moved) == (1, 1)
    assert (labels == PERSON).sum() == 0
    far = Persistence(moved_m=0.1)
    assert things_in(watch(8, lambda _: [new]), scene, far)[0].moved == 0
    fixed = Persistence(movable=("Chair",))
    assert things_in(watch(8, lambda _: [new]), scene, fixed)[0].moved == 0


def test_an_object_that_is_still_there_is_not_found_elsewhere():
    assert things_in(watch(8, lambda _: [(5.3, 3.4, 6.5, 3.9)]))[0].moved == 0


@pytest.mark.parametrize("plan", ["cafeteria", "pillar-hall"])
def test_people_who_stand_survive_and_unmapped_things_do_not(plan):
    """In simulated halls, people stand as long as the recording lasts: only legs tell them."""
    world = perturb(draw_world(plan, 11, clutter=False), 11)
    recording = simulate_recording(world, HOKUYO_UTM_30LX_EW, seed=11, scans=500)
    found, labels = things_in(recording.batch, recording.scene_map)
    truth, valid = recording.batch.labels, recording.batch.valid
    people, clutter = valid & (truth == PERSON), valid & (truth == OTHER)
    assert (labels[people] == PERSON).mean() > 0.9
    assert (labels[clutter] == PERSON).mean() < 0.2
    assert found.standing > 4
    assert found.things > 10


def test_things_of_a_fine_map_lie_where_they_are():
    coarse_map = rooms.room_map()
    fine = replace(
        coarse_map,
        occupancy=coarse_map.occupancy.repeat(2, 0).repeat(2, 1),
        labels=coarse_map.labels.repeat(2, 0).repeat(2, 1),
        resolution=rooms.RESOLUTION / 2,
    )
    _, labels = things_in(watch(8, lambda _: [BOX]), fine)
    assert (labels == PERSON).sum() == 0


def test_without_things_every_cell_is_as_the_map_says():
    layer = NO_THINGS.layer((4, 5))
    assert layer.shape == (4, 5)
    assert (layer == UNLABELLED).all()
    assert FREE not in layer


@pytest.mark.parametrize(
    "limits", [{"min_seconds": 0}, {"min_share": 0.0}, {"moved_m": -1.0}, {"min_share": 1.1}]
)
def test_limits_out_of_range_are_refused(limits):
    with pytest.raises(InvalidInputError, match="persistence"):
        Persistence(**limits)
