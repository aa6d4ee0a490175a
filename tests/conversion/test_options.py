import pytest

from conversion.options import Options, options_from
from semantic2d_dataset.errors import InvalidInputError


def test_options_are_made_of_plain_values():
    said = {
        "scan_topics": ["/scan"],
        "clock_offset_s": 1,
        "max_gap_s": None,
        "mount": [0, 0, 0.1, 0, 0, 3.14],
        "no_return": [0, 81.83],
        "reverse_intensities": True,
        "license": "MIT",
    }
    assert options_from(said) == Options(
        scan_topics=("/scan",),
        clock_offset_s=1.0,
        mount=(0.0, 0.0, 0.1, 0.0, 0.0, 3.14),
        no_return=(0.0, 81.83),
        reverse_intensities=True,
        license="MIT",
    )
    assert options_from({}) == Options()


def test_every_option_can_be_said():
    defaults = {name: getattr(Options(), name) for name in Options.__dataclass_fields__}
    assert options_from(defaults) == Options()


@pytest.mark.parametrize(
    ("said", "says"),
    [
        ({"pose": "tf"}, "unknown option 'pose'; did you mean 'poses'"),
        ({3: "tf"}, "unknown option 3; known are base_frame, clock_offset_s"),
        ({"poses": None}, "poses: expected text, found None"),
        ({"scan_topics": "/scan"}, "scan_topics: expected a list of texts, found '/scan'"),
        ({"scan_topics": [1]}, r"scan_topics: expected a list of texts, found \[1\]"),
        ({"no_return": 0}, "no_return: expected a list of numbers, found 0"),
        ({"max_gap_s": "1"}, "max_gap_s: expected a number, found '1'"),
        ({"max_gap_s": True}, "max_gap_s: expected a number, found True"),
        ({"max_gap_s": -1}, "max_gap_s: expected a number of seconds, 0 or more, found -1"),
        ({"reverse_intensities": 1}, "reverse_intensities: expected true or false, found 1"),
        ({"mount": [1, 2]}, r"mount: expected six numbers \[x, y, z, roll, pitch, yaw\], found"),
    ],
)
def test_what_is_no_option_is_told(said, says):
    with pytest.raises(InvalidInputError, match=says):
        options_from(said)
