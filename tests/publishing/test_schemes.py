import numpy as np
import pytest

from semantic2d_dataset.errors import CorruptFileError
from semantic2d_dataset.format.manifest import Manifest, SequenceEntry
from semantic2d_dataset.format.split_schemes import schemes_of
from semantic2d_dataset.format.splits import NONE, TEST, TRAIN, SplitScheme, write_scheme
from semantic2d_dataset.publishing.schemes import read_schemes, schemes_for

PLACES = ("attic", "lobby", "office", "roof")


def stamps_of(*names, scans=400):
    return {name: np.arange(scans) * 50_000_000 for name in names}


def manifest_of(stamps, schemes):
    entries = tuple(
        SequenceEntry("f", 0, "0", name, "0", len(each), "a", "b", "c")
        for name, each in stamps.items()
    )
    return Manifest("rooms", "1.0.0", "MIT", entries, dict.fromkeys(schemes))


@pytest.fixture
def before():
    stamps = stamps_of(*(f"{place}--one--a" for place in PLACES))
    schemes = {scheme.name: scheme for scheme in schemes_of(stamps)}
    return stamps, schemes, manifest_of(stamps, schemes)


def extended(before, *names, **options):
    stamps, schemes, manifest = before
    found = schemes_for(stamps | stamps_of(*names, **options), schemes, manifest)
    return {scheme.name: scheme.membership for scheme in found}


def test_without_any_scheme_the_standard_ones_are_made(before):
    assert {scheme.name for scheme in schemes_for(before[0], {}, None)} == {*before[1]}


def test_sequences_that_are_known_change_no_scheme(before):
    for scheme in schemes_for(before[0], before[1], before[2]):
        assert (scheme.made_by, scheme.digest) == (
            before[1][scheme.name].made_by,
            before[1][scheme.name].digest,
        )


def test_another_lidar_joins_the_blocks_of_its_recording(before):
    found = extended(before, "office--one--b", scans=800)["block"]
    old = found["office--one--a"]
    assert np.array_equal(found["office--one--b"][:400], old)
    assert (found["office--one--b"][400:] == old[-1]).all()


def test_another_recording_joins_the_split_of_its_environment(before):
    found = extended(before, *(f"{place}--two--a" for place in (*PLACES, "garden")))["environment"]
    for place in PLACES:
        assert set(found[f"{place}--two--a"]) == set(found[f"{place}--one--a"])
    assert set(found["garden--two--a"]) == {TRAIN}


def test_another_recording_joins_the_lidar_scheme_as_its_lidar_is_used(before):
    stamps, schemes, _ = before
    ids = {name: np.full(400, TEST, np.uint8) for name in stamps}
    ids["attic--one--b"] = np.full(400, TRAIN, np.uint8)
    stamps = stamps | stamps_of("attic--one--b")
    schemes = schemes | {"lidar": SplitScheme("lidar", ids, "train b; test a")}
    new = ("x--one--a", "x--one--b", "x--one--c")
    found = extended((stamps, schemes, manifest_of(stamps, schemes)), *new)
    assert set(found["lidar"]["x--one--a"]) == {TEST}
    block = found["block"]["x--one--b"]
    assert np.array_equal(found["lidar"]["x--one--b"], np.where(block == TEST, NONE, block))
    assert TRAIN in found["lidar"]["x--one--b"]
    assert set(found["lidar"]["x--one--c"]) == {NONE}


def test_what_a_scheme_of_ones_own_left_out_stays_out_and_what_is_new_is_in_no_split(before):
    stamps, schemes, _ = before
    own = SplitScheme("own", {"attic--one--a": np.zeros(400, np.uint8)}, "by hand")
    schemes = schemes | {"own": own}
    found = extended((stamps, schemes, manifest_of(stamps, schemes)), "garden--one--a")["own"]
    assert found.keys() == {"attic--one--a", "garden--one--a"}
    assert set(found["garden--one--a"]) == {NONE}


def test_a_scheme_that_was_removed_is_made_anew(before):
    stamps, schemes, manifest = before
    kept = {name: scheme for name, scheme in schemes.items() if name != "environment"}
    assert "environment" in {each.name for each in schemes_for(stamps, kept, manifest)}


def test_a_file_under_the_name_of_another_scheme_is_refused(before, tmp_path):
    write_scheme(tmp_path / "block.h5", before[1]["frame"])
    with pytest.raises(CorruptFileError, match="expected the scheme block, found frame"):
        read_schemes(tmp_path)
