import pytest

from salsa.settings import Settings, read_settings, settings_from
from salsa.things import Persistence
from semantic2d_dataset.errors import InvalidInputError


def test_nothing_said_is_the_default():
    assert settings_from({}) == Settings()


def test_what_is_said_takes_the_place_of_the_default():
    found = settings_from(
        {
            "persistence": {"min_seconds": 9, "movable": ["Chair"]},
            "acceptance": {"max_correction_m": 3},
            "transfer": {"ignore_no_return": True},
        }
    )
    assert found.persistence == Persistence(min_seconds=9, movable=("Chair",))
    assert repr(found.acceptance.max_correction_m) == "3.0"  # a whole number is as good
    assert found.transfer.ignore_no_return
    assert settings_from({"persistence": None}).persistence is None


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"persistance": {}}, "unknown key 'persistance'; did you mean 'persistence'"),
        ({"transfer": {"object": 0.1}}, "transfer: unknown key 'object'; did you mean 'object_m'"),
        ({"transfer": {"object_m": "near"}}, "object_m: expected a value like 0.15, found 'near'"),
        ({"transfer": {"ignore_no_return": 1}}, "expected a value like False, found 1"),
        ({"persistence": {"movable": "Chair"}}, "movable: expected a value like"),
        ({"persistence": {"min_seconds": 2.5}}, "min_seconds: expected a value like 5"),
        ({"persistence": {"min_seconds": 10**400}}, "min_seconds: expected a value like 5"),
        ({"lines": {"max_line_gap": 10**400}}, r"max_line_gap: expected a value like 1\.0"),
        ({"acceptance": None}, "acceptance: expected a mapping, found None"),
        ({"acceptance": {"inlier_m": 7.0}}, "acceptance limits"),
    ],
)
def test_what_cannot_be_is_refused_by_its_name(values, message):
    with pytest.raises(InvalidInputError, match=message):
        settings_from(values)


def test_a_file_is_changed_by_what_is_said_beside_it(tmp_path):
    file = tmp_path / "salsa.yaml"
    file.write_text("persistence: {moved_m: 2.0}\nacceptance: {max_correction_m: 4}", "utf-8")
    found = read_settings(file, {"persistence": {"min_seconds": 9}, "smoothing": {}})
    assert found.persistence == Persistence(min_seconds=9, moved_m=2.0)
    assert found.acceptance.max_correction_m == 4
    assert found.smoothing is not None
    assert read_settings(file, {"persistence": None}).persistence is None
    assert read_settings(None, {}) == Settings()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1]", "salsa.yaml: expected a mapping"),
        ("a: [", "salsa.yaml: not a YAML file"),
        ("lines: {gap: 1}", "salsa.yaml: salsa: lines: unknown key 'gap'"),
    ],
)
def test_a_file_that_cannot_be_understood_is_named(text, message, tmp_path):
    (tmp_path / "salsa.yaml").write_text(text, "utf-8")
    with pytest.raises(InvalidInputError, match=message):
        read_settings(tmp_path / "salsa.yaml", {})
