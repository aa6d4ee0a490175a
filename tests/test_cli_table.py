import pandas as pd
import pytest

from semantic2d_dataset import cli, scan_table


def run(monkeypatch, *words):
    monkeypatch.setattr("sys.argv", ["semantic2d", "table", *map(str, words)])
    with pytest.raises(SystemExit) as end:
        cli.main()
    return end.value.code


def test_a_table_is_written_as_csv(dataset_folder, tmp_path, monkeypatch, capsys):
    out = tmp_path / "scans.csv"
    assert run(monkeypatch, dataset_folder, "--out", out) == 0
    assert capsys.readouterr().out.startswith(f"wrote {out}: 450 scans, ")
    found = pd.read_csv(out)
    assert found.columns.tolist() == scan_table(dataset_folder).columns.tolist()
    assert run(monkeypatch, dataset_folder, "--out", out) == 1
    assert "exists already; choose another name or use --force" in capsys.readouterr().err
    assert run(monkeypatch, dataset_folder, "--out", out, "--force", "--no-beams") == 0
    assert "beams_wall" not in pd.read_csv(out)


def test_a_name_of_another_kind_is_refused_before_anything_is_read(tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, tmp_path, "--out", tmp_path / "scans.xlsx") == 1
    assert "expected a name that ends in .csv or .parquet" in capsys.readouterr().err
