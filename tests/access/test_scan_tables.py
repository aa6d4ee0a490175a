import numpy as np
import pandas as pd
import pytest

from semantic2d_dataset import load_dataset, open_dataset
from semantic2d_dataset.access.scan_tables import scan_table, write_table
from semantic2d_dataset.errors import DatasetNotFoundError, InvalidInputError
from tests.generators import SMALL_LIDAR, make_arrays


@pytest.fixture(scope="module")
def table(dataset_folder):
    return scan_table(dataset_folder)


def test_each_scan_has_a_row_with_its_place_time_and_pose(table):
    arrays = make_arrays(150, seed=0)
    assert len(table) == 450
    row = table.loc[157]
    assert row["scan_id"] == "lobby--first--small/7"
    assert (row["environment"], row["recording"], row["lidar"]) == ("lobby", "first", "small")
    assert (row["sequence_id"], row["index"]) == ("lobby--first--small", 7)
    assert row["stamp"].value == arrays["scans/stamps_ns"][7]
    np.testing.assert_array_equal(row[["x", "y", "yaw"]], arrays["poses/refined"][7])
    assert "accepted" not in table


def test_beams_are_counted_as_loaders_count_them(table, dataset_folder):
    ranges = make_arrays(150, seed=0)["scans/ranges"]
    expected = SMALL_LIDAR.has_return(ranges).mean(1)
    np.testing.assert_allclose(table["return_share"][150:300], expected, rtol=1e-6)
    counted = load_dataset(dataset_folder, lidar="small", split=None).scan_class_counts
    columns = [name for name in table if name.startswith("beams_")]
    assert columns[-2:] == ["beams_trash_bin", "beams_wall"]
    np.testing.assert_array_equal(table[columns], counted)


def test_each_scheme_has_a_column(table, dataset_folder):
    data = open_dataset(dataset_folder)
    for scheme in ("block", "environment", "frame"):
        column = table[f"split_{scheme}"]
        assert column.cat.categories.tolist() == ["train", "val", "test"]
        for split in ("train", "val", "test"):
            source = load_dataset(dataset_folder, lidar="small", scheme=scheme, split=split).source
            assert table["scan_id"][column == split].tolist() == source.scan_ids.tolist()
        gaps = sum((ids == 255).sum() for ids in data.scheme(scheme).membership.values())
        assert column.isna().sum() == gaps


def test_without_beams_the_rest_is_the_same(table, dataset_folder):
    quick = scan_table(open_dataset(dataset_folder), lidar="small", beams=False)
    pd.testing.assert_frame_equal(quick, table[quick.columns.tolist()])
    assert not [name for name in quick if name.startswith("beams") or name == "return_share"]


def test_an_unknown_lidar_is_named(dataset_folder):
    with pytest.raises(DatasetNotFoundError, match="no sequence of the lidar 'velodyne'"):
        scan_table(dataset_folder, lidar="velodyne")


def test_a_written_table_reads_back(table, tmp_path):
    write_table(tmp_path / "scans.csv", table)
    again = pd.read_csv(tmp_path / "scans.csv", parse_dates=["stamp"])
    assert again["scan_id"].tolist() == table["scan_id"].tolist()
    np.testing.assert_array_equal(again["x"], table["x"])
    with pytest.raises(InvalidInputError, match=r"ends in .csv or .parquet"):
        write_table(tmp_path / "scans.xlsx", table)


def test_parquet_keeps_types(table, tmp_path):
    pytest.importorskip("pyarrow")
    write_table(tmp_path / "scans.parquet", table)
    again = pd.read_parquet(tmp_path / "scans.parquet")
    assert again["split_block"].dtype == "category"
    assert again["stamp"].dtype == table["stamp"].dtype
