import sys

import dask
import numpy as np
import pytest

from semantic2d_dataset.access.dask_arrays import dask_arrays
from semantic2d_dataset.access.scan_tables import scan_table
from semantic2d_dataset.errors import InvalidInputError
from tests.clusters import cluster
from tests.generators import make_arrays


def expected(name):
    return np.concatenate([make_arrays(150, seed=seed)[name] for seed in (1, 0, 2)])


@pytest.mark.parametrize("scheduler", ["synchronous", "threads"])
def test_arrays_are_those_of_all_sequences(dataset_folder, scheduler):
    arrays = dask_arrays(dataset_folder, "small", chunks_in_block=1)
    assert set(arrays) == {"ranges", "intensities", "labels", "stamps_ns", "poses"}
    assert arrays["ranges"].chunks[0] == (64, 64, 22) * 3  # blocks end with their files
    with dask.config.set(scheduler=scheduler):
        for name, array in arrays.items():
            stored = "poses/refined" if name == "poses" else f"scans/{name}"
            values = array.compute()
            np.testing.assert_array_equal(values, expected(stored))
            assert (values.shape, values.dtype) == (array.shape, array.dtype)


def test_rows_are_those_of_the_table(dataset_folder):
    arrays = dask_arrays(dataset_folder, "small")
    test = (scan_table(dataset_folder, beams=False)["split_block"] == "test").to_numpy()
    kept = arrays["labels"][test]
    np.testing.assert_array_equal(kept.compute(), expected("scans/labels")[test])


def test_nothing_is_read_before_it_is_computed(dataset_folder, monkeypatch):
    read = []
    monkeypatch.setattr(
        "semantic2d_dataset.format.sequence.SequenceReader.read",
        lambda *what: read.append(what),
    )
    arrays = dask_arrays(dataset_folder, "small")
    assert arrays["ranges"].shape == (450, 37)
    assert not read


def test_a_block_without_a_chunk_is_refused(dataset_folder):
    with pytest.raises(InvalidInputError, match="expected 1 or more, found 0"):
        dask_arrays(dataset_folder, "small", chunks_in_block=0)


def test_without_dask_it_says_what_to_install(dataset_folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "dask", None)
    monkeypatch.setitem(sys.modules, "dask.array", None)
    with pytest.raises(ImportError, match=r"pip install 'semantic2d-dataset\[dask\]'"):
        dask_arrays(dataset_folder, "small")


@pytest.mark.long
def test_processes_and_a_cluster_compute_the_same(dataset_folder, tmp_path):
    from distributed import Client

    counts = (dask_arrays(dataset_folder, "small", chunks_in_block=1)["labels"] == 9).sum(axis=0)
    known = (expected("scans/labels") == 9).sum(axis=0)
    with dask.config.set(scheduler="processes", num_workers=2):
        np.testing.assert_array_equal(counts.compute(), known)
    with cluster(tmp_path) as (address, _), Client(address):
        np.testing.assert_array_equal(counts.compute(), known)
