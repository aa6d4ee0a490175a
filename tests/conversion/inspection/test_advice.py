"""What to do with a recording."""

import shlex
from pathlib import Path

import pytest

from conversion.inspection.advice import command_line, in_words
from conversion.inspection.findings import Suggestion
from conversion.options import Options


def words(path="drive.bag", files=None, options=(), suggestions=()):
    proposed = [Suggestion(option, "because") for option in suggestions]
    given = [Path(name) for name in files or [path]]
    return shlex.split(command_line(Path(path), given, Options(**dict(options)), proposed))


def test_defaults_need_no_options():
    assert words() == ["semantic2d", "convert", "drive.bag", "--out", "sequences"]


def test_what_was_given_is_given_again():
    options = {
        "scan_topics": ("/a", "/b c"),
        "mount": (0.1, 0, 0, 3.14159265, 0, 0),
        "max_gap_s": 0.75,
        "drop_without_pose": True,
        "recording": "first",
    }
    assert words(options=options)[3:-2] == [
        *("--scan-topic", "/a", "--scan-topic", "/b c", "--max-gap", "0.75"),
        *("--mount", "0.1,0,0,3.14159265,0,0", "--drop-without-pose", "--recording-name", "first"),
    ]


def test_a_suggestion_takes_the_place_of_what_was_given():
    found = words(options={"stamps": "header"}, suggestions=["--stamps record"])
    assert found[3:-2] == ["--stamps", "record"]


def test_values_for_no_return_add_up():
    found = words(options={"no_return": (0.0,)}, suggestions=["--no-return 81.83"])
    assert found[3:-2] == ["--no-return", "0.0", "--no-return", "81.83"]


def test_names_with_spaces_survive_the_shell():
    assert words("my drive.bag")[2] == "my drive.bag"
    found = words(suggestions=["--poses 'FLASER pose'"])
    assert found[3:-2] == ["--poses", "FLASER pose"]


def test_several_files_of_one_recording_are_all_named():
    found = words("d_0.mcap", files=["d_0.mcap", "d_1.mcap"])
    assert found[2:-2] == ["d_0.mcap", "d_1.mcap", "--merge"]


@pytest.mark.parametrize(
    ("path", "files"),
    [("bag", ["bag/metadata.yaml", "bag/a.db3"]), ("table.yaml", ["scans.npy", "poses.npy"])],
)
def test_folders_and_descriptions_stand_for_their_files(path, files):
    assert words(path, files=files)[2:-2] == [path]


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (0.0421, "42.1 ms"),
        (3.0, "3.0 s"),
        (7200.0, "2.0 h"),
        (86400.0 * 3, "3.0 days"),
        (86400.0 * 365.25, "1.0 years"),
    ],
)
def test_times_have_the_unit_that_suits_them(seconds, said):
    assert in_words(seconds) == said
