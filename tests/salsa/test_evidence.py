from dataclasses import replace

import numpy as np

from salsa.evidence import Ledger, coarse, gather, look_length
from salsa.fields import map_field
from tests.salsa import rooms

BOX = (5.1, 2.4, 5.4, 2.7)
POSE = rooms.true_poses(2)[:1]


def watch(seconds, boxes_at, rate=20):
    """A robot at rest that looks for some seconds; `boxes_at` gives what stands there then."""
    stamps = np.arange(int(seconds * rate)) / rate
    ranges = np.stack(
        [rooms.batch_at(POSE, POSE, extra=boxes_at(t), noise=0.0).ranges[0] for t in stamps]
    )
    batch = rooms.batch_at(POSE, POSE)
    return replace(
        batch,
        ranges=ranges,
        poses=POSE.repeat(len(stamps), axis=0),
        stamps_ns=1_700_000_000 * 10**9 + (stamps * 1e9).astype(np.int64),
    )


def counted(batch, accepted=None):
    field = map_field(rooms.room_map())
    accepted = np.ones(len(batch), bool) if accepted is None else accepted
    look_s = look_length(batch.stamps_ns)
    found = gather(batch, batch.poses, accepted, field, look_s=look_s)
    return Ledger(coarse(field)[1], look_s).add(found)


def edge_of(box):
    """The coarse cell of the middle of the box's side that faces the robot."""
    return int((box[1] + box[3]) / 2 / rooms.RESOLUTION), int((box[2] - 0.01) / rooms.RESOLUTION)


def test_what_stays_is_met_and_held_in_every_look_and_seen_through_in_none():
    found = counted(watch(4, lambda _: [BOX]))
    assert found.met[edge_of(BOX)] == 4
    assert found.held[edge_of(BOX)] == 4
    assert found.passed[edge_of(BOX)] == 0
    assert found.hits[edge_of(BOX)] >= 4 * 20


def test_what_leaves_is_seen_through_afterwards():
    found = counted(watch(6, lambda t: [BOX] if t < 2 else []))
    assert found.met[edge_of(BOX)] == 2
    assert found.passed[edge_of(BOX)] == 4


def test_what_comes_and_goes_within_a_look_holds_none():
    found = counted(watch(6, lambda t: [BOX] if t % 1 < 0.4 else []))
    assert found.met[edge_of(BOX)] == 6
    assert found.held[edge_of(BOX)] == 0


def test_looks_do_not_depend_on_the_rate_of_the_lidar():
    for rate in (5, 40):
        found = counted(watch(3, lambda _: [BOX], rate))
        assert (found.met[edge_of(BOX)], found.held[edge_of(BOX)]) == (3, 3)
    slow = counted(watch(12, lambda _: [BOX], rate=1))  # a look takes four scans
    assert (slow.met[edge_of(BOX)], slow.held[edge_of(BOX)], slow.look_s) == (3, 3, 4.0)


def test_blocks_add_up_to_the_whole():
    batch = watch(4, lambda t: [BOX] if t < 2 else [])
    field = map_field(rooms.room_map())
    ledger = Ledger(coarse(field)[1])
    for rows in (slice(0, 40), slice(40, 80)):  # whole seconds
        part = replace(
            batch,
            ranges=batch.ranges[rows],
            poses=batch.poses[rows],
            stamps_ns=batch.stamps_ns[rows],
        )
        ledger.add(gather(part, part.poses, np.ones(40, bool), field))
    whole = counted(batch)
    for name in ("hits", "met", "held", "passed"):
        np.testing.assert_array_equal(getattr(ledger, name), getattr(whole, name))
    np.testing.assert_allclose(ledger.offsets, whole.offsets)


def test_beams_end_where_the_offsets_say():
    found = counted(watch(1, lambda _: [BOX]))
    row, column = edge_of(BOX)
    mean = found.offsets[row, column] / found.hits[row, column]
    assert abs((column + 0.5 + mean[0]) * rooms.RESOLUTION - BOX[2]) < 0.06


def test_scans_that_are_not_accepted_say_nothing():
    batch = watch(2, lambda _: [BOX])
    found = counted(batch, np.zeros(len(batch), bool))
    assert not found.hits.any()
    assert not found.passed.any()


def test_fine_maps_are_counted_in_cells_of_five_centimetres():
    field = map_field(rooms.room_map())
    fine = replace(field, resolution=0.01)
    assert coarse(field) == (1, rooms.SHAPE)
    assert coarse(fine) == (5, (28, 36))
