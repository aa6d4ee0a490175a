import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy


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
