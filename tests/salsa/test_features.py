import numpy as np

from salsa.features import points_near_lines

SEGMENT = np.array([[4.0, -1.0, 4.0, 1.0]], np.float32)
OFFSETS = np.array([0, 1])


def near(*points):
    return points_near_lines(np.array([points]), SEGMENT, OFFSETS)[0].tolist()


def test_points_near_a_segment_are_marked_and_others_not():
    assert near((4.0, 0.0), (4.25, 0.5), (3.75, 1.9), (4.35, 0.0)) == [True, True, True, False]
    assert near((4.0, 2.1), (-4.0, 0.0), (np.nan, np.nan)) == [False, False, False]


def test_segments_mark_the_points_of_their_own_scan_only():
    points = np.full((3, 1, 2), 4.0) * (1.0, 0.0)
    marked = points_near_lines(points, SEGMENT, np.array([0, 0, 1, 1]))
    assert marked[:, 0].tolist() == [False, True, False]


def test_a_segment_without_length_marks_nothing_and_hinders_no_other():
    segments = np.concatenate((np.full((1, 4), 4.0, np.float32), SEGMENT))
    points = np.array([[(4.0, 0.0), (4.0, 4.0)]])
    assert points_near_lines(points, segments, np.array([0, 2]))[0].tolist() == [True, False]
