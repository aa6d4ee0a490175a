import numpy as np
import pytest

from semantic2d_dataset.errors import CorruptFileError, InvalidInputError
from semantic2d_dataset.format.split_schemes import make_block_scheme
from semantic2d_dataset.format.splits import (
    VAL,
    SplitScheme,
    read_scheme,
    split_id,
    write_scheme,
)


def test_scheme_reads_back_the_same(tmp_path):
    scheme = make_block_scheme(
        {name: np.arange(n) * 50_000_000 for name, n in (("e--r--a", 1200), ("e--s--a", 600))}
    )
    lengths = {i: len(ids) for i, ids in scheme.membership.items()}
    write_scheme(tmp_path / "block.h5", scheme)
    found = read_scheme(tmp_path / "block.h5", "block", lengths)
    assert (found.name, found.made_by, found.digest) == (
        scheme.name,
        scheme.made_by,
        scheme.digest,
    )


def test_scheme_of_another_name_is_refused(tmp_path):
    write_scheme(tmp_path / "s.h5", SplitScheme("s", {"e--r--a": np.zeros(4, np.uint8)}, ""))
    with pytest.raises(CorruptFileError, match="expected the scheme block, found s"):
        read_scheme(tmp_path / "s.h5", "block", {"e--r--a": 4})


@pytest.mark.parametrize("lengths", [{"e--r--a": 3}, {}])
def test_scheme_for_other_sequences_is_refused(lengths, tmp_path):
    write_scheme(tmp_path / "s.h5", SplitScheme("s", {"e--r--a": np.zeros(4, np.uint8)}, ""))
    with pytest.raises(CorruptFileError, match="e--r--a: 4 members for a sequence of"):
        read_scheme(tmp_path / "s.h5", "s", lengths)


def test_membership_outside_the_domain_is_refused():
    with pytest.raises(InvalidInputError, match="expected only 0 train"):
        SplitScheme("s", {"e--r--a": np.array([0, 3], np.uint8)}, "")


def test_dev_is_val_and_unknown_splits_list_the_known():
    assert split_id("dev") == split_id("val") == VAL
    with pytest.raises(InvalidInputError, match="unknown split 'validation'; known are train"):
        split_id("validation")


def test_unknown_sequence_is_named():
    scheme = SplitScheme("s", {"e--r--a": np.array([0, 2], np.uint8)}, "")
    assert scheme.scans_of("e--r--a", "test").tolist() == [1]
    with pytest.raises(InvalidInputError, match="does not cover x"):
        scheme.scans_of("x", "test")
