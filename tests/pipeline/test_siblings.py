import sys

import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.pipeline.siblings import load_sibling


def test_a_module_of_a_sibling_is_found_by_name():
    assert load_sibling("conversion", "options").Options().poses == "auto"
    assert load_sibling("leaderboard").app is not None


def test_shadowing_package_is_named_with_a_way_out(tmp_path, monkeypatch):
    (tmp_path / "conversion").mkdir()
    (tmp_path / "conversion" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "conversion", raising=False)
    monkeypatch.delitem(sys.modules, "conversion.cli", raising=False)
    with pytest.raises(InvalidInputError, match=f"Python finds {tmp_path}/conversion first"):
        load_sibling("conversion")
