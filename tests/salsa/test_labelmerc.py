from importlib.resources import files

import yaml

from salsa.labelmerc import labelmerc
from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy


def test_the_shipped_file_is_what_the_taxonomy_gives():
    assert files("salsa").joinpath("labelmerc.yaml").read_text(encoding="utf-8") == labelmerc()


def test_labels_and_colours_are_those_of_the_classes():
    settings = yaml.safe_load(labelmerc())
    assert sorted(settings["labels"]) == sorted(SEMANTIC2D.names)
    assert settings["labels"][-1] == "Other"
    colours = dict(zip(SEMANTIC2D.names, map(list, SEMANTIC2D.colours), strict=True))
    assert settings["label_colors"] == colours


def test_labelme_refuses_other_names_and_uses_the_colours():
    # names and values as in default_config.yaml and the checks of labelme 5.11 and 6.3
    settings = yaml.safe_load(labelmerc())
    assert settings["validate_label"] == "exact"
    assert settings["shape_color"] == "manual"
    assert settings["sort_labels"] is False
    assert settings["store_data"] is False
    assert settings["auto_save"] is True
    assert len(settings) == 7


def test_any_class_name_is_read_back_as_it_was():
    names = ("Other", "Person", "it's: a #1", "yes", "12", '"x"\\')
    own = Taxonomy(names, tuple((i, i, i) for i in range(len(names))))
    settings = yaml.safe_load(labelmerc(own))
    assert sorted(settings["labels"]) == sorted(names)
    assert settings["label_colors"]["12"] == [4, 4, 4]
