"""What docs/loading.md shows works as it stands there."""

import re

import pytest

from tests.conftest import PROJECT

PAGE = (PROJECT / "docs" / "loading.md").read_text(encoding="utf-8")


@pytest.mark.usefixtures("mini")
def test_every_snippet_runs_after_the_ones_before_it():
    names: dict[str, object] = {}
    for code in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        if "publish(" not in code:  # which is of a folder of one's own
            exec(code, names)
    assert names["stack"].shape == (5, 3, 1081)
    assert names["walls"].shape == (1081,)
    assert names["share"].between(0, 1).all()
