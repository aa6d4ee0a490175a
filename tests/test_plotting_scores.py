import numpy as np
import pytest

from semantic2d_dataset.plotting import save
from semantic2d_dataset.plotting_scores import (
    CONDITIONS,
    band_label,
    plot_class_bars,
    plot_condition,
    plot_confusion,
    plot_reliability,
)
from semantic2d_dataset.scoring.calibration import Calibration
from semantic2d_dataset.scoring.conditions import BANDS
from semantic2d_dataset.scoring.metrics import Evaluator


def example_result():
    rng = np.random.default_rng(2)
    shares = np.array((0.02, 0.05, 0.1, 0.03, 0.11, 0.02, 0.13, 0.06, 0, 0.48))
    truth = rng.choice(10, 50_000, p=shares / shares.sum())
    skill = np.array((0.2, 0.45, 0.7, 0.5, 0.85, 0.6, 0.8, 0.5, 0, 0.95))
    prediction = np.where(rng.random(truth.size) < skill[truth], truth, rng.integers(0, 10, 50_000))
    return Evaluator().update(truth, prediction).compute()


def test_confusion_shows_percent_of_the_true_class_and_a_dash_for_absent_classes():
    result = Evaluator().update([1, 1, 1, 1, 2], [1, 1, 1, 9, 2]).compute()
    ax = plot_confusion(result).axes[0]
    texts = np.array([text.get_text() for text in ax.texts]).reshape(10, 10)
    assert (texts[1, 1], texts[1, 9], texts[2, 2]) == ("75.0", "25.0", "100.0")
    assert set(texts[4]) == {"-"}
    assert ax.get_yticklabels()[1].get_text() == "Chair (4)"


def test_bars_have_the_lengths_of_iou_and_dots_stand_at_ca():
    result = example_result()
    ax = plot_class_bars(result).axes[0]
    assert ax.patches[4].get_width() == pytest.approx(100 * result["Person"]["iou"])
    dots = {int(y): x for x, y in ax.lines[0].get_xydata()}
    assert dots[4] == pytest.approx(100 * result["Person"]["ca"])
    assert result["Trash bin"]["ca"] is None
    assert 8 not in dots


def test_class_that_nobody_names_has_no_bar_but_the_word_none():
    ax = plot_class_bars(Evaluator().update([1, 9], [1, 9]).compute()).axes[0]
    assert [text.get_text() for text in ax.texts] == ["none"] * 8


def test_whiskers_span_the_intervals_of_the_classes_that_have_one():
    result = example_result()
    classes = dict.fromkeys(("Other", "Chair", "Door", "Elevator", "Person", "Pillar", "Sofa"))
    classes |= {"Table": [0.25, 0.75], "Trash bin": None, "Wall": [0.5, 0.625]}
    result["intervals"] = {"level": 0.95, "classes": classes}
    figure = plot_class_bars(result)
    spans = [s.tolist() for s in figure.axes[0].collections[0].get_segments()]
    assert spans == [[[25, 7], [75, 7]], [[50, 9], [62.5, 9]]]
    assert "95 % interval" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_bands_stand_in_order_with_their_points_and_units():
    bands = {
        "0-1": {"mIoU": 0.25, "points": 1200, "classes_averaged": {"mIoU": 9}},
        "16+": {"mIoU": None, "points": 3, "classes_averaged": {"mIoU": 0}},
    }
    figure = plot_condition({"mIoU": 0.5, "conditions": {"range_m": bands}}, "range_m")
    ax = figure.axes[0]
    assert [text.get_text() for text in ax.get_yticklabels()] == ["0 to 1 m", "16 m and more"]
    assert [bar.get_width() for bar in ax.patches] == [25, 0]
    assert [text.get_text() for text in ax.texts] == ["25.0", "none"]
    assert ax.lines[0].get_xdata() == [50, 50]  # all points
    points = [text.get_text() for text in ax.child_axes[0].get_yticklabels()]
    assert points == ["points (classes)", "1,200 (9)", "3 (0)"]
    assert ax.get_xlabel() == "mIoU (%)"


def test_motion_is_told_by_class_accuracy():
    bands = {"static": {"mCA": 0.75, "points": 2, "classes_averaged": {"mCA": 8}}}
    figure = plot_condition({"mCA": 0.5, "conditions": {"motion": bands}}, "motion")
    assert figure.axes[0].get_xlabel() == "mCA (%)"


def test_every_condition_has_a_title_and_every_band_a_label_of_its_own():
    assert set(CONDITIONS) == {*BANDS, "environment"}
    for name, bands in BANDS.items():
        assert len({band_label(name, band) for band in bands}) == len(bands)
    assert band_label("incidence_deg", "60-75") == "60 to 75°"
    assert band_label("incidence_deg", "unknown") == "unknown"
    assert band_label("environment", "hall-2") == "hall-2"


def test_reliability_has_the_heights_of_the_bins_and_the_share_of_points_below():
    rng = np.random.default_rng(0)
    probabilities = rng.dirichlet(np.full(10, 0.2), (1, 5000)).astype(np.float32)
    result = Calibration().update(rng.integers(0, 10, (1, 5000)), probabilities).compute()
    (accuracy, error), (below, _) = np.reshape(plot_reliability(result).axes, (2, 2))
    for ax, rows, figure in (
        (accuracy, result["confidence_bins"], "accuracy"),
        (error, result["entropy_bins"], "error"),
    ):
        heights = [bar.get_height() for bar in ax.patches]
        assert heights == pytest.approx([100 * (row[figure] or 0) for row in rows])
    assert sum(bar.get_height() for bar in below.patches) == pytest.approx(100)
    assert accuracy.lines[0].get_xydata().tolist() == [[0, 0], [1, 100]]


def test_pictures_of_an_empty_result_can_be_drawn(tmp_path):
    save(plot_reliability(Calibration().compute()), tmp_path / "reliability.png")
    for n, plot in enumerate((plot_confusion, plot_class_bars)):
        save(plot(Evaluator().compute()), tmp_path / f"{n}.png")
