import pickle

import pytest

from semantic2d_dataset import errors

LEAVES = [
    value
    for value in vars(errors).values()
    if isinstance(value, type) and issubclass(value, errors.Semantic2DError)
]


@pytest.mark.parametrize("error", LEAVES)
def test_every_error_is_drawn_in_the_tree(error):
    assert error.__name__ in errors.__doc__


@pytest.mark.parametrize(
    ("error", "builtin"),
    [
        (errors.DatasetNotFoundError, FileNotFoundError),
        (errors.InvalidInputError, ValueError),
        (errors.SubmissionError, ValueError),
        (errors.WriteError, OSError),
    ],
)
def test_errors_are_also_what_python_calls_them(error, builtin):
    assert issubclass(error, builtin)


def test_submission_error_lists_every_problem():
    error = errors.SubmissionError("p.h5", ["one", "two"])
    assert error.problems == ("one", "two")
    assert str(error) == "p.h5: 2 problem(s) found\n  - one\n  - two"


def test_recording_error_names_the_recording():
    error = errors.RecordingError("a.bag", "no scan topic")
    assert str(error) == "a.bag: no scan topic"
    assert error.path == "a.bag"


@pytest.mark.parametrize(
    "error",
    [errors.RecordingError("a.bag", "bad"), errors.SubmissionError("p.h5", ["one", "two"])],
)
def test_errors_travel_between_processes(error):
    again = pickle.loads(pickle.dumps(error))
    assert str(again) == str(error)
