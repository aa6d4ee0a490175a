import dataclasses
import json
import re
import shutil
import xml.etree.ElementTree as ET

import pytest

from leaderboard.adding import add_entry
from leaderboard.at_hand import AtHand
from leaderboard.checking import check_entries
from leaderboard.entries import file_name, seal, to_json
from leaderboard.published import published_entries
from leaderboard.rows import is_ranked, make_tables
from leaderboard.site import build_site
from semantic2d_dataset.errors import InvalidInputError
from tests.leaderboard.boards import edited, with_extras


@pytest.fixture
def at_hand(dataset_folder, predictions_folder):
    return AtHand([str(dataset_folder)], predictions_folder)


def contents(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def pages_of(folder):
    return {str(name): content.decode() for name, content in contents(folder).items()}


def first(board):
    path = sorted(board.iterdir())[0]
    return path, json.loads(path.read_text())


def test_rows_stand_by_miou_and_verified_ones_say_so(board, at_hand, tmp_path):
    assert build_site(tmp_path / "site", board, at_hand) == 3
    start = (tmp_path / "site" / "index.html").read_text()
    names = re.findall(r'<th scope="row"><a href="methods/[^"]+">(\w+)</a>', start)
    assert names == ["Good", "Fair", "Poor"]
    assert start.count('<span class="badge verified">') == 3


def test_entries_without_predictions_are_shown_as_unverified(board, tmp_path):
    build_site(tmp_path / "site", board, AtHand())
    pages = pages_of(tmp_path / "site")
    assert pages["index.html"].count('<span class="badge unverified">') == 3
    assert not any("Prediction of" in page for page in pages.values())


def test_scans_are_drawn_beside_truth_where_predictions_are_at_hand(board, at_hand, tmp_path):
    build_site(tmp_path / "site", board, at_hand)
    page = next(p for name, p in pages_of(tmp_path / "site").items() if "good" in name)
    assert page.count('aria-label="Prediction of ') == 4
    assert page.count('aria-label="Truth of ') == 4


def test_published_rows_have_a_track_and_no_rank(board, at_hand, tmp_path):
    for entry in published_entries():
        add_entry(entry, board)
    assert build_site(tmp_path / "site", board, at_hand) == 20
    start = (tmp_path / "site" / "index.html").read_text()
    own, published = start.split('<section class="track"')[1:]
    assert "badge as-published" in published
    assert "badge as-published" not in own
    assert published.count('class="unranked"') == 17
    page = next(p for name, p in pages_of(tmp_path / "site").items() if "s3-net-ipa." in name)
    assert "37.20 %, is not that of its own classes, 37.22 %" in page


def test_the_same_entries_give_the_same_bytes(board, at_hand, tmp_path):
    build_site(tmp_path / "one", board, at_hand)
    build_site(tmp_path / "two", board, at_hand)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_a_wrong_entry_stops_the_build_and_leaves_the_old_pages(board, at_hand, tmp_path):
    build_site(tmp_path / "site", board, at_hand)
    before = contents(tmp_path / "site")
    path, said = first(board)
    path.write_text(to_json(edited(said, ("result", "mIoU"))))
    with pytest.raises(InvalidInputError, match=r"result\.mIoU"):
        build_site(tmp_path / "site", board, at_hand)
    assert contents(tmp_path / "site") == before


def test_only_a_folder_of_pages_is_replaced(board, tmp_path):
    build_site(tmp_path / "site", board, AtHand())
    build_site(tmp_path / "site", board, AtHand())
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").touch()
    for out, message in (
        (tmp_path / "mine", "holds something else"),
        (board, "holds something else"),
        (tmp_path / "mine" / "thesis.txt", "is a file"),
    ):
        with pytest.raises(InvalidInputError, match=message):
            build_site(out, board, AtHand())
    assert (tmp_path / "mine" / "thesis.txt").exists()
    assert {path.name for path in tmp_path.iterdir()} == {"site", "mine", "entries"}


def test_a_folder_without_entries_gives_no_pages(tmp_path):
    (tmp_path / "none").mkdir()
    with pytest.raises(InvalidInputError, match="no entries"):
        build_site(tmp_path / "site", tmp_path / "none", AtHand())


HOSTILE = {
    "method": "</title><script>alert(1)</script>\"'><img src=x onerror=alert(2)>{{ 7 * 7 }}",
    "authors": ["<svg onload=alert(3)>"],
    "code": "javascript:alert(4)",
    "hardware": 'https://host/" onclick="alert(5)',
}


def test_hostile_names_and_addresses_are_text(board, tmp_path):
    path, said = first(board)
    metadata = dict(HOSTILE)
    said = seal(said | {"metadata": {name: metadata[name] for name in ("method", "authors")}})
    path.unlink()
    (board / file_name(said)).write_text(to_json(said))
    build_site(tmp_path / "site", board, AtHand())
    for page in pages_of(tmp_path / "site").values():
        assert "<script>alert" not in page
        assert "<img" not in page
        assert "<svg onload" not in page
        assert "49" not in re.findall(r"alert\(2\)&gt;(.{0,20})", page)


@pytest.mark.parametrize(
    "address",
    [
        "javascript:alert(1)",
        "JAVASCRIPT:alert(1)",
        "java\tscript:alert(1)",
        " javascript:alert(1)",
        "data:text/html,<script>alert(1)</script>",
        "//host/x",
        "https://",
        "file:///etc/passwd",
        "https://[bad",
    ],
)
def test_only_addresses_of_web_pages_become_links(address):
    from leaderboard.site import _web

    assert not _web(address)
    assert _web("https://host/a?b=c")


def test_pages_are_well_formed_and_name_nothing_outside(board, at_hand, tmp_path):
    path, said = first(board)
    path.write_text(to_json(with_extras(said)))
    build_site(tmp_path / "site", board, AtHand())
    for name, page in pages_of(tmp_path / "site").items():
        assert not re.search(r"(src|action|srcset|data)\s*=\s*\"(https?:)?//", page), name
        assert "@import" not in page
        assert not re.search(r"url\(", page)
        assert not re.search(r"\sstyle=|\son\w+=", page), name
        for svg in re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL):
            ET.fromstring(svg)


def test_a_bin_without_figures_is_not_drawn(board, tmp_path):
    path, said = first(board)
    said = with_extras(said)
    said["result"]["calibration"]["confidence_bins"][-1]["points"] = 7
    path.write_text(to_json(seal(said)))
    assert build_site(tmp_path / "site", board, AtHand()) == 3


def test_conditions_intervals_and_calibration_are_shown(board, tmp_path):
    path, said = first(board)
    path.write_text(to_json(with_extras(said)))
    build_site(tmp_path / "site", board, AtHand())
    page = (tmp_path / "site" / "methods" / f"{path.stem}.html").read_text()
    assert "Range, m" in page
    assert "Angle of incidence" in page
    assert "Expected calibration error 10.00 %" in page
    assert "50.00 ± 1.00 %" in page
    assert page.count('class="whisker"') == 9
    assert 'class="interval"' in (tmp_path / "site" / "index.html").read_text()


def test_several_lidars_are_tracks_of_their_own(tmp_path):
    from dataclasses import replace

    from tests.generators import SMALL_LIDAR, make_dataset
    from tests.leaderboard.boards import add, write_predictions

    lidars = (SMALL_LIDAR, replace(SMALL_LIDAR, name="tiny", beams=11))
    make_dataset(tmp_path / "data", lidars=lidars, scans=60)
    (tmp_path / "entries").mkdir()
    predictions = write_predictions(tmp_path / "p.h5", tmp_path / "data")
    add(predictions, tmp_path / "data", tmp_path / "entries")
    shutil.move(predictions, tmp_path / "data" / "p.h5")
    at_hand = AtHand([str(tmp_path / "data")], tmp_path / "data")
    build_site(tmp_path / "site", tmp_path / "entries", at_hand)
    start = (tmp_path / "site" / "index.html").read_text()
    assert start.count('<section class="track"') == 2


@pytest.fixture
def seeds_beside_others(board, entry_of_seeds):
    """Three methods of one training each, and one of three seeds."""
    add_entry(entry_of_seeds, board)
    return board


def test_seeds_are_one_row_at_their_mean_with_its_deviation(
    seeds_beside_others, entry_of_seeds, tmp_path
):
    build_site(tmp_path / "site", seeds_beside_others, AtHand())
    start = (tmp_path / "site" / "index.html").read_text()
    spread = entry_of_seeds["seeds"]["spread"]
    mean, std = (f"{100 * spread['mIoU'][name]:.2f}" for name in ("mean", "std"))
    (row,) = (part for part in start.split("<tr")[1:] if ">Net</a>" in part)
    assert f'data-value="{spread["mIoU"]["mean"]}"' in row
    assert f'{mean} <span class="std">± {std}</span>' in row
    assert '<span class="badge">3 seeds</span>' in row.replace(
        'class="badge 3-seeds"', 'class="badge"'
    )
    chair = spread["classes"]["Chair"]["ca"]
    assert f'{100 * chair["mean"]:.1f} <span class="std">± {100 * chair["std"]:.1f}</span>' in row


def test_a_rank_is_that_of_the_mean_and_not_of_the_seed_that_is_shown(
    board, entry_of_seeds, predictions_folder, seeds_folder, dataset_folder, tmp_path
):
    """Another method stands between the two."""
    add_entry(entry_of_seeds, board)
    for folder in (predictions_folder, seeds_folder):
        shutil.copytree(folder, tmp_path / "predictions" / folder.name)
    at_hand = AtHand([str(dataset_folder)], tmp_path / "predictions")
    (table,) = make_tables(check_entries(board, at_hand))
    (row,) = (row for row in table.rows if row.entry.runs)
    assert row.scores.mIoU.value == entry_of_seeds["seeds"]["spread"]["mIoU"]["mean"]
    assert row.scores.mIoU.value != entry_of_seeds["result"]["mIoU"]
    values = [row.scores.mIoU.value for row in table.rows]
    assert values == sorted(values, reverse=True)
    assert table.best("iou") == values[0]
    assert table.best("iou", "Chair") == max(
        r.scores.classes["iou"]["Chair"].value for r in table.rows
    )


def test_only_verified_rows_have_a_rank(board, predictions_folder, dataset_folder, tmp_path):
    shutil.copy(predictions_folder / "fair.h5", tmp_path / "fair.h5")
    (table,) = make_tables(check_entries(board, AtHand([str(dataset_folder)], tmp_path)))
    assert [(row.entry.method, row.place) for row in table.rows] == [
        ("Good", None),
        ("Fair", 1),
        ("Poor", None),
    ]
    assert table.best("iou") == table.rows[1].scores.mIoU.value


def test_frame_has_no_ranks(board, predictions_folder, dataset_folder):
    (checked, *_) = check_entries(board, AtHand([str(dataset_folder)], predictions_folder))
    (track,) = checked.entry.tracks()
    assert is_ranked(track, checked)
    assert not is_ranked(dataclasses.replace(track, scheme="frame"), checked)


def test_the_page_of_seeds_says_which_one_is_shown_and_lists_all(
    seeds_beside_others, entry_of_seeds, tmp_path
):
    build_site(tmp_path / "site", seeds_beside_others, AtHand())
    page = next(p for name, p in pages_of(tmp_path / "site").items() if "--net." in name)
    assert "those of <b>seed 0</b>, which has the median mIoU" in page
    assert "over 3 seeds" in page
    for n, run in enumerate(entry_of_seeds["seeds"]["runs"]):
        assert (
            f"<dt>SHA-256 of the predictions, seed {n}</dt><dd><code>{run['predictions']}" in page
        )
        assert f"<td>{100 * run['per_lidar']['small']['mIoU']:.2f}</td>" in page
    counts = entry_of_seeds["result"]["per_lidar"]["small"]["confusion"]
    assert f'title="{counts[1][1]:,} points"' in page


def test_pages_of_one_training_say_nothing_of_seeds(board, tmp_path):
    build_site(tmp_path / "site", board, AtHand())
    for name, page in pages_of(tmp_path / "site").items():
        assert "By seed" not in page, name
        assert "seeds</span>" not in page, name


def test_scans_of_the_seed_that_is_shown_are_drawn(
    board_of_seeds, dataset_folder, seeds_folder, tmp_path
):
    build_site(tmp_path / "site", board_of_seeds, AtHand([str(dataset_folder)], seeds_folder))
    page = next(p for name, p in pages_of(tmp_path / "site").items() if "--net." in name)
    assert page.count('aria-label="Prediction of ') == 4
