import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy, read_taxonomy


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("Other", 0),
        ("_background_", 0),
        ("people", 4),
        ("PERSON", 4),
        ("trash_bin", 8),
        ("Trash can", 8),
        (" wall ", 9),
    ],
)
def test_names_match_whatever_their_published_spelling(name, expected):
    assert SEMANTIC2D.id_of(name) == expected


def test_unknown_class_lists_the_known_ones():
    with pytest.raises(InvalidInputError, match="unknown class 'Lamp'; known are Other, Chair"):
        SEMANTIC2D.id_of("Lamp")


def test_background_is_never_scored():
    assert SEMANTIC2D.scored_ids == tuple(range(1, 10))


def test_palette_has_the_published_colours_and_one_for_unlabelled():
    assert SEMANTIC2D.palette[9].tolist() == [227, 0, 0]
    assert SEMANTIC2D.palette[4].tolist() == [204, 204, 204]
    assert SEMANTIC2D.palette.shape == (256, 3)


def test_digest_tells_taxonomies_apart():
    other = Taxonomy(("Other", "Wall"), ((0, 0, 0), (1, 1, 1)))
    assert other.digest != SEMANTIC2D.digest
    assert other.digest == Taxonomy(("Other", "Wall"), ((0, 0, 0), (1, 1, 1))).digest


@pytest.mark.parametrize(
    ("names", "colours", "background"),
    [
        (("A",), ((0, 0, 0),), 0),
        (("A", "B"), ((0, 0, 0),), 0),
        (("A", "a"), ((0, 0, 0), (1, 1, 1)), 0),
        (("A", "B\x1b[2J"), ((0, 0, 0), (1, 1, 1)), 0),
        (("A", "B"), ((0, 0, 0), (1, 1, 1)), 2),
    ],
)
def test_taxonomy_that_cannot_be_is_refused(names, colours, background):
    with pytest.raises(InvalidInputError):
        Taxonomy(names, colours, background)


def written(tmp_path, text):
    (tmp_path / "classes.yaml").write_text(text, encoding="utf-8")
    return tmp_path / "classes.yaml"


def test_classes_come_from_a_file(tmp_path):
    text = "classes: {floor: [9, 9, 9], wall: [200, 0, 0], Nothing: [0, 0, 0]}\nbackground: nothing"
    found = read_taxonomy(written(tmp_path, text))
    assert found.names == ("floor", "wall", "Nothing")
    assert found.colours[1] == (200, 0, 0)
    assert found.background_id == 2


def test_a_file_adds_classes_to_those_of_the_release(tmp_path):
    text = "extends: semantic2d\nclasses: {Dog: [120, 80, 20]}"
    found = read_taxonomy(written(tmp_path, text))
    assert found.names == (*SEMANTIC2D.names, "Dog")
    assert found.background_id == SEMANTIC2D.background_id


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1]", "expected a mapping with `classes`"),
        ("classes: {a: [0, 0, 0]}\nnames: 1", "expected a mapping with `classes`"),
        ("classes: [", "not a YAML file"),
        ("classes: {a: [0, 0, 256]}", "names with a colour"),
        ("classes: {a: red}", "names with a colour"),
        ("classes: {a: [0, 0, 0]}", "expected 2 to 255 class names, found 1"),
        ("extends: other\nclasses: {a: [0, 0, 0]}", "extends: expected semantic2d"),
        ("extends: semantic2d\nclasses: {people: [0, 0, 0]}", "class names must differ"),
        ("classes: {a: [0, 0, 0], b: [1, 1, 1]}\nbackground: c", "unknown class 'c'"),
    ],
)
def test_a_file_of_another_form_is_refused_by_its_name(text, message, tmp_path):
    with pytest.raises(InvalidInputError, match=message) as told:
        read_taxonomy(written(tmp_path, text))
    assert "classes.yaml" in str(told.value)
