"""What docs/splits.md shows works as it stands there."""

import re
import warnings

from semantic2d_dataset import open_dataset
from semantic2d_dataset.errors import LeakageWarning
from tests.conftest import PROJECT
from tests.generators import make_sequence

TEXT = (PROJECT / "docs" / "splits.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def test_a_scheme_of_ones_own_is_published_by_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_data" / "sequences").mkdir(parents=True)
    for day in ("monday", "tuesday-noon"):
        make_sequence(tmp_path / "my_data" / "sequences" / f"{day}.h5", 200, recording=day)
    exec(next(block for block in BLOCKS if "publish(" in block), {})
    data = open_dataset(tmp_path / "my_data")
    days = data.scheme("days")
    assert len(days.scans_of("lobby--tuesday-noon--small", "test")) == 200
    assert not len(days.scans_of("lobby--monday--small", "test"))
    assert len(days.scans_of("lobby--monday--small", "train")) > 100


def test_the_warning_is_silenced_by_the_page():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        exec(next(block for block in BLOCKS if "filterwarnings" in block), {})
        warnings.warn("leaks", LeakageWarning, stacklevel=1)


def test_a_test_lidar_is_loaded_by_the_page(mini):
    found = {}
    exec(next(block for block in BLOCKS if "statistics=" in block), found)
    assert len(found["test"]) == 2040
    assert found["test"].statistics == found["train"].statistics


def test_figures_of_the_page_are_those_of_mini(mini):
    from semantic2d_dataset.format.leakage import audit_schemes, read_tracks
    from semantic2d_dataset.format.leakage_report import percent

    schemes = [mini.scheme(name) for name in mini.manifest.splits]
    for audit in audit_schemes(schemes, read_tracks(mini.root, mini.manifest)):
        said = audit.of("test").summarise()
        figures = [percent(said[n]) for n in ("next_to_train", "within_1_s", "within_25_cm_15_deg")]
        assert f"| `{audit.scheme.name}` | {' | '.join(figures)} |" in TEXT
