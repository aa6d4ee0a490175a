from __future__ import annotations

from baselines.charts import plot_classes, plot_features
from baselines.tables import Row
from semantic2d_dataset.scoring.published import ALL


def row(method: str, *figures: float, published: bool = False) -> Row:
    names = (ALL, "Chair", "Wall")
    spread = {name: (figure, 0.01) for name, figure in zip(names, figures, strict=True)}
    return Row(method, None, {"CA": spread, "IoU": spread}, published=published)


LOW, HIGH = row("low", 0.2, 0.1, 0.3), row("high", 0.8, 0.9, 0.7)
PRINTED = row("printed", 0.3, 0.2, 0.4, published=True)


def test_every_bar_is_seen_to_its_end_whichever_is_drawn_first():
    for figure in (
        plot_classes([LOW, HIGH, PRINTED], ("Chair", "Wall")),
        plot_features({"R": LOW, "RI": HIGH}, {"R": PRINTED}),
        plot_features({"R": LOW}, {"R": HIGH}),
    ):
        (ax,) = figure.axes
        tops = [bar.get_height() for bar in ax.patches if bar.get_height() > 0]
        assert ax.get_ylim()[0] == 0
        assert ax.get_ylim()[1] >= max(tops) + 1  # percent, the spread included


def test_published_bars_are_hatched_and_named_so():
    figure = plot_classes([LOW, PRINTED], ("Chair", "Wall"))
    hatched = [bar for bar in figure.axes[0].patches if bar.get_hatch()]
    assert sorted(bar.get_height() for bar in hatched) == [20.0, 40.0]
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["low", "printed, as published, other data"]
