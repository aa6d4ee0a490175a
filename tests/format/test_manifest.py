import contextlib
import json
import shutil
import subprocess
from dataclasses import replace

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from semantic2d_dataset.errors import (
    ChecksumError,
    CorruptFileError,
    DatasetNotFoundError,
    FormatVersionError,
    InvalidInputError,
    Semantic2DError,
)
from semantic2d_dataset.format.manifest import (
    describe_document,
    find_problems,
    publish,
    read_manifest,
    write_digests,
    write_manifest,
)
from semantic2d_dataset.format.sequence import SequenceReader
from tests.generators import make_sequence


@pytest.fixture
def copy(dataset_folder, tmp_path):
    return shutil.copytree(dataset_folder, tmp_path / "copy")


def test_manifest_describes_every_sequence(dataset_folder):
    manifest = read_manifest(dataset_folder)
    assert (manifest.name, manifest.version, manifest.license) == ("generated", "1.0.0", "CC0-1.0")
    assert sorted(manifest.splits) == ["block", "environment", "frame"]
    for entry in manifest.sequences:
        with SequenceReader(dataset_folder / entry.file) as reader:
            assert entry.id == reader.header.sequence_id
            assert entry.scans == len(reader) == 150
            assert entry.content_digest == reader.content_digest()


def test_good_data_set_has_no_problem(dataset_folder):
    assert find_problems(dataset_folder) == []
    assert find_problems(dataset_folder, full=True) == []


def test_publishing_again_describes_the_same_data(copy):
    before = read_manifest(copy)
    after = publish(copy, name="generated", version="1.0.1", license="CC0-1.0")
    assert [e.content_digest for e in after.sequences] == [
        e.content_digest for e in before.sequences
    ]
    assert after.version == "1.0.1"


def damage(path, position):
    data = bytearray(path.read_bytes())
    data[position] ^= 0x01
    path.write_bytes(data)


def test_any_flipped_bit_is_found_by_full_verification(copy):
    entry = read_manifest(copy).sequences[0]
    good = (copy / entry.file).read_bytes()
    for position in np.linspace(0, entry.bytes - 1, 40).astype(int).tolist():
        damage(copy / entry.file, position)
        problems = find_problems(copy, full=True)
        assert [type(p) for p in problems] == [ChecksumError]
        assert entry.file in str(problems[0])
        (copy / entry.file).write_bytes(good)


def test_missing_truncated_and_damaged_files_are_all_listed(copy):
    manifest = read_manifest(copy)
    files = [copy / entry.file for entry in manifest.files]
    files[0].unlink()
    files[1].write_bytes(files[1].read_bytes()[:-1])
    damage(copy / manifest.splits["block"].file, 900)
    problems = [str(problem) for problem in find_problems(copy, full=True)]
    assert len(problems) == 3
    assert "missing" in problems[0]
    assert "expected" in problems[1]
    assert "SHA-256" in problems[2]


def test_exchanged_sequences_are_found_without_hashing(copy):
    first, second = (copy / e.file for e in read_manifest(copy).sequences[:2])
    swap = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(swap)
    assert len(find_problems(copy)) == 2


def test_folder_without_manifest_is_not_found(tmp_path):
    with pytest.raises(DatasetNotFoundError, match=r"no data set here \(there is no dataset.json"):
        read_manifest(tmp_path)


def test_folder_without_sequences_cannot_be_published(tmp_path):
    with pytest.raises(DatasetNotFoundError, match="no sequences"):
        publish(tmp_path, name="x", version="1.0.0")


@pytest.mark.parametrize(
    ("name", "version", "says"),
    [("Has Spaces", "1.0.0", "such as 'has-spaces'"), ("good", "1.0", "expected one like 1.0.0")],
)
def test_bad_name_or_version_is_refused_before_anything_is_written(name, version, says, copy):
    before = (copy / "splits" / "block.h5").stat().st_mtime_ns
    with pytest.raises(InvalidInputError, match=says):
        publish(copy, name=name, version=version)
    assert (copy / "splits" / "block.h5").stat().st_mtime_ns == before


def test_file_name_that_no_manifest_may_hold_is_refused_with_a_proposal(copy):
    make_sequence(copy / "sequences" / "My Lab.h5", 5, recording="second")
    with pytest.raises(InvalidInputError, match="give the file a name like my-lab.h5"):
        publish(copy, name="x", version="1.0.0")


def test_two_files_with_one_sequence_cannot_be_published(copy):
    make_sequence(copy / "sequences" / "zz.h5", 5)
    with pytest.raises(InvalidInputError, match="zz.h5: is the sequence lobby--first--small, and"):
        publish(copy, name="x", version="1.0.0")


def test_exchanged_schemes_are_found(copy):
    def swap(said):
        splits = said["splits"]
        splits["block"], splits["frame"] = splits["frame"], splits["block"]

    rewrite(copy, swap)
    problems = [str(problem) for problem in find_problems(copy)]
    assert len(problems) == 2
    assert "expected the scheme block, found frame" in problems[0] + problems[1]


@pytest.mark.parametrize(
    ("name", "values", "says"),
    [
        ("scans/stamps_ns", np.arange(150)[::-1], "go backward"),
        ("scans/labels", np.full((150, 37), 77, np.uint8), "expected 0 to 9 or 255, found 77"),
    ],
)
def test_values_outside_their_domain_are_found_by_full_verification(name, values, says, tmp_path):
    path = tmp_path / "sequences" / "a.h5"
    path.parent.mkdir()
    make_sequence(path, 150)
    with h5py.File(path, "r+") as file:
        file[name][...] = values
    publish(tmp_path, name="x", version="1.0.0", schemes=[])
    assert find_problems(tmp_path) == []
    (problem,) = find_problems(tmp_path, full=True)
    assert says in str(problem)


def rewrite(folder, change):
    path = folder / "dataset.json"
    said = json.loads(path.read_text())
    change(said)
    path.write_text(json.dumps(said))


def test_newer_major_manifest_says_what_reads_it(copy):
    rewrite(copy, lambda said: said.update(format_version="2.0", future=True))
    with pytest.raises(FormatVersionError, match="semantic2d-dataset 2.0 or later"):
        read_manifest(copy)


@pytest.mark.parametrize(
    "change",
    [
        lambda said: said.pop("name"),
        lambda said: said.update(format="zip"),
        lambda said: said["sequences"][0].update(file="../../etc/passwd"),
        lambda said: said["sequences"][0].update(file="/etc/passwd"),
        lambda said: said["sequences"][0].update(sha256="0"),
        lambda said: said["sequences"].append(said["sequences"][0]),
        lambda said: said["splits"].update(block={"file": "splits/../x.h5"}),
        lambda said: said.update(extra=1),
        lambda said: said.update(format_version="\u00b2"),
        lambda said: said.update(format_version="9" * 5000),
    ],
)
def test_manifest_that_breaks_its_schema_is_refused(change, copy):
    rewrite(copy, change)
    with pytest.raises(CorruptFileError, match="dataset.json"):
        read_manifest(copy)


@pytest.mark.parametrize("text", ["", "[]", "null", "{", '"x"', "[" * 100_000, "\x00"])
def test_file_that_is_no_manifest_is_refused(text, tmp_path):
    (tmp_path / "dataset.json").write_text(text)
    with pytest.raises(CorruptFileError, match="dataset.json"):
        read_manifest(tmp_path)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(data=st.data())
def test_mutated_manifest_gives_only_our_errors(data, dataset_folder, tmp_path):
    text = bytearray((dataset_folder / "dataset.json").read_bytes())
    for _ in range(data.draw(st.integers(1, 5))):
        position = data.draw(st.integers(0, len(text) - 1))
        text[position] = data.draw(st.integers(0, 255))
    (tmp_path / "dataset.json").write_bytes(text)
    with contextlib.suppress(Semantic2DError):
        read_manifest(tmp_path)


@pytest.fixture
def with_documents(copy):
    (copy / "splits" / "frame").mkdir()
    (copy / "splits" / "frame" / "train.txt").write_text("0000000.npy\n")
    (copy / "CARD.md").write_text("all about it")
    documents = [describe_document(copy, name) for name in ("CARD.md", "splits/frame/train.txt")]
    manifest = replace(read_manifest(copy), documents=tuple(documents))
    write_manifest(copy, manifest)
    write_digests(copy, manifest)
    assert read_manifest(copy) == manifest
    return copy


def said_by(folder):
    return json.loads((folder / "dataset.json").read_text())


def test_documents_are_verified(with_documents):
    assert find_problems(with_documents, full=True) == []
    (with_documents / "CARD.md").write_text("all about I.")
    assert [type(problem) for problem in find_problems(with_documents, full=True)] == [
        ChecksumError
    ]
    (with_documents / "splits" / "frame" / "train.txt").unlink()
    assert any("train.txt: missing" in str(each) for each in find_problems(with_documents))


def test_a_manifest_without_documents_is_written_as_ever(dataset_folder):
    assert said_by(dataset_folder)["format_version"] == "1.0"
    assert "documents" not in said_by(dataset_folder)


def test_sha256sum_checks_every_file_but_its_own(with_documents):
    done = subprocess.run(
        ["sha256sum", "-c", "SHA256SUMS"],
        cwd=with_documents,
        capture_output=True,
        text=True,
        check=True,
    )
    files = {str(p.relative_to(with_documents)) for p in with_documents.rglob("*") if p.is_file()}
    checked = {line.removesuffix(": OK") for line in done.stdout.splitlines()}
    assert checked == files - {"SHA256SUMS"}


def test_digests_that_list_something_else_are_found_and_a_new_manifest_removes_them(with_documents):
    sums = with_documents / "SHA256SUMS"
    sums.write_text(sums.read_text().replace("a", "b", 1))
    assert any("SHA256SUMS" in str(each) for each in find_problems(with_documents))
    publish(with_documents, name="generated", version="1.0.1")
    assert not sums.exists()
    assert find_problems(with_documents, full=True) == []


@pytest.mark.parametrize("name", ["../x", "/x", "a/../x", ".x", "a/.x", "dataset.json", "a//b", ""])
def test_document_that_leads_out_or_is_hidden_is_refused(name, with_documents):
    said = said_by(with_documents)
    said["documents"][0]["file"] = name
    (with_documents / "dataset.json").write_text(json.dumps(said))
    with pytest.raises(CorruptFileError, match="documents"):
        read_manifest(with_documents)


def test_what_a_newer_minor_manifest_adds_is_passed_over(with_documents):
    before, said = read_manifest(with_documents), said_by(with_documents)
    said["mood"] = "good"
    said["sequences"][0]["weather"] = "fine"
    (with_documents / "dataset.json").write_text(json.dumps(said))
    with pytest.raises(CorruptFileError, match="mood|weather"):
        read_manifest(with_documents)
    (with_documents / "dataset.json").write_text(json.dumps(said | {"format_version": "1.2"}))
    assert read_manifest(with_documents) == before
