import re
import shutil

import numpy as np
import pytest
import yaml

from semantic2d_dataset.access.registry import OpenDataset
from semantic2d_dataset.format.manifest import read_manifest
from semantic2d_dataset.format.sequence import SequenceReader
from semantic2d_dataset.publishing.about import About, read_about
from semantic2d_dataset.publishing.card import make_card
from semantic2d_dataset.publishing.facts import gather_facts
from semantic2d_dataset.publishing.release import release
from tests.conftest import PROJECT
from tests.publishing.rooms import make_rooms


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = make_rooms(tmp_path_factory.mktemp("card") / "rooms")
    release(folder, version="1.0.0", name="rooms", license="CC-BY-4.0")
    return folder


def rows_of(card, heading):
    """Cells of the table whose first column is headed so."""
    table = card.split(f"| {heading} |", 1)[1].split("\n\n", 1)[0]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]


def test_shares_in_the_card_are_those_of_the_labels(folder):
    counts, total = np.zeros(10, int), 0
    for path in (folder / "sequences").glob("*.h5"):
        with SequenceReader(path) as reader:
            batch, names = reader.batch(), reader.header.taxonomy.names
            total += len(batch)
            counts += np.bincount(batch.labels[batch.valid & (batch.labels != 255)], minlength=10)
    card = (folder / "DATASET_CARD.md").read_text()
    rows = rows_of(card, "class")
    shares = counts / counts.sum()
    assert [row[0] for row in rows[:-1]] == list(names)
    assert [row[-1] for row in rows[:-1]] == [f"{share:.1%}" for share in shares]
    assert rows[-1][-1] == f"{counts.sum():,}"
    assert f"\n{total:,} scans in 3 sequences" in card


def test_sizes_of_splits_in_the_card_are_those_of_the_schemes(folder):
    data = OpenDataset(folder, read_manifest(folder))
    rows = {
        row[0].strip("`"): row
        for row in rows_of((folder / "DATASET_CARD.md").read_text(), "scheme")
    }
    assert rows.keys() == data.manifest.splits.keys()
    for name, row in rows.items():
        members = np.concatenate(list(data.scheme(name).membership.values()))
        assert row[1:5] == [f"{(members == split).sum():,}" for split in (0, 1, 2, 255)]
    assert rows["block"][5] == "0.0%"
    assert float(rows["frame"][5].rstrip("%")) > 85  # 91 in the long run


def test_front_matter_is_what_hugging_face_reads(folder):
    _, front, body = (folder / "DATASET_CARD.md").read_text().split("---\n", 2)
    said = yaml.safe_load(front)
    assert said["license"] == "cc-by-4.0"
    assert said["size_categories"] == ["n<1K"]
    assert said["task_categories"] == ["other"]
    assert body.startswith("\n# Some rooms\n")


def test_what_the_makers_say_is_in_the_card(folder):
    card = (folder / "DATASET_CARD.md").read_text()
    for text in ("Ann Author, A university", "All of them.", "To be tested with."):
        assert text in card


def test_a_card_without_words_says_that_nobody_said_them(folder):
    card = make_card(gather_facts(OpenDataset(folder, read_manifest(folder))), About())
    assert "Not said by those who made it." in card
    assert "does not mean that there are none" in card


def test_the_card_of_a_released_data_set_is_the_one_in_it(folder):
    data = OpenDataset(folder, read_manifest(folder))
    card = make_card(gather_facts(data), read_about(folder))
    assert card == (folder / "DATASET_CARD.md").read_text()


def test_another_license_is_named_beside_the_word_other(folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    release(copy, version="1.0.1", license="LicenseRef-Ours")
    front = yaml.safe_load((copy / "DATASET_CARD.md").read_text().split("---\n")[1])
    assert (front["license"], front["license_name"]) == ("other", "LicenseRef-Ours")


def test_the_card_of_this_project_is_that_of_its_data_set(mini):
    """Where this fails, run `make card`."""
    card = make_card(gather_facts(mini), read_about(mini.root, mini.manifest.name))
    committed = (PROJECT / "DATASET_CARD.md").read_text(encoding="utf-8")
    version = re.compile(r"semantic2d_dataset [0-9.]+ simulation")  # of whoever made it here
    assert version.sub("", committed) == version.sub("", card)
