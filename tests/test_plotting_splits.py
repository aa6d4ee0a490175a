"""The picture of an audit: readable for two sequences and for sixty, whatever is missing."""

import numpy as np
import pytest

from semantic2d_dataset.format.leakage import Track, audit_schemes
from semantic2d_dataset.format.split_schemes import schemes_of
from semantic2d_dataset.format.splits import SplitScheme
from semantic2d_dataset.plotting import save
from semantic2d_dataset.plotting_splits import plot_audits


def make_tracks(environments, lidars, *, scans=100):
    rng = np.random.default_rng(0)
    return [
        Track(
            f"environment-{i:02}--r--{lidar}",
            np.arange(scans) * 50_000_000,
            np.cumsum(rng.normal(0, 0.1, (scans, 3)), axis=0),
        )
        for i in range(environments)
        for lidar in lidars
    ]


def draw(tracks, schemes=None):
    stamps = {track.sequence_id: track.stamps_ns for track in tracks}
    audits = audit_schemes(schemes or schemes_of(stamps), tracks)
    return plot_audits(audits), audits


def strips(figure):
    return [row.axes[0] for row in figure.subfigs]


@pytest.mark.parametrize(
    ("environments", "lidars", "named"), [(1, "ab", 2), (4, "abcd", 4), (20, "abc", 0)]
)
def test_lines_are_named_where_there_is_room(environments, lidars, named, tmp_path):
    figure, audits = draw(make_tracks(environments, lidars))
    assert len(figure.subfigs) == len(audits)
    for strip in strips(figure):
        assert strip.images[0].get_array().shape[:2] == (environments * len(lidars), 600)
        assert len(strip.get_yticklabels()) == named
    save(figure, tmp_path / "audit.png", dpi=40)
    assert (tmp_path / "audit.png").stat().st_size > 5000


def test_headlines_carry_the_verdict_and_the_shares():
    figure, _ = draw(make_tracks(4, "a"))
    row = {each.get_suptitle().split(":")[0]: each for each in figure.subfigs}["frame"]
    assert " % of test scans lie next to a train scan" in row.get_suptitle()
    assert [ax.get_title() for ax in row.axes] == [
        "4 sequences, a line each",
        "test within 1 s of train: 100 %",
        "test within 0.25 m and 15° of train: 100 %",
    ]


@pytest.mark.parametrize(
    ("ids", "words"),
    [
        (255, ["no test scan", "no test scan with a pose"]),
        (
            2,
            ["no train scan in any\nrecording of a test scan", "no train scan in any\nenvironment"],
        ),
    ],
)
def test_what_is_not_there_is_said_in_its_place(ids, words):
    tracks = make_tracks(2, "a")
    membership = {track.sequence_id: np.full(100, ids, np.uint8) for track in tracks}
    figure, _ = draw(tracks, [SplitScheme("own", membership, "")])
    _, time, pose = figure.subfigs[0].axes
    for ax, text in zip((time, pose), words, strict=True):
        assert ax.texts[0].get_text().startswith(text)


def test_colours_of_the_splits_differ_in_lightness():
    from semantic2d_dataset.plotting_splits import _COLOURS

    weights = (0.2126, 0.7152, 0.0722)
    light = sorted(
        sum(w * int(c[k : k + 2], 16) for w, k in zip(weights, (1, 3, 5), strict=True))
        for c in _COLOURS.values()
    )
    assert min(np.diff(light)) > 25
