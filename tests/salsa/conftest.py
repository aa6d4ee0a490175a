"""A labelled recording shared by the tests of what is made of one."""

import numpy as np
import pytest

from salsa.sequences import label_sequence
from tests.salsa import rooms
from tests.salsa.test_sequences import write_source

SCANS = 60
BLIND = range(20, 24)  # these scans show something else
LOST = 5  # has no pose


@pytest.fixture(scope="session")
def labelled_room(tmp_path_factory):
    """A labelled sequence of which four scans do not fit and one has no pose; do not change it."""
    folder = tmp_path_factory.mktemp("labelled")
    truth = rooms.true_poses(SCANS)
    batch = rooms.batch_at(truth, rooms.rough_poses(truth, metres=0.25))
    rng = np.random.default_rng(5)
    batch.ranges[BLIND] = rng.uniform(0.2, 2.5, (len(BLIND), rooms.LIDAR.beams))
    batch.poses[LOST] = np.nan
    write_source(folder / "source.h5", batch)
    map_yaml, annotation = rooms.write_room(folder)
    label_sequence(folder / "source.h5", map_yaml, annotation, folder / "labelled.h5")
    return folder / "labelled.h5"
