"""What docs/pipeline.md shows works as it stands there."""

import re

from semantic2d_dataset import open_dataset
from semantic2d_dataset.executors import Serial
from semantic2d_dataset.pipeline.config import read_config
from semantic2d_dataset.pipeline.steps import run_pipeline
from tests.conftest import PROJECT
from tests.pipeline.drives import room_drive
from tests.salsa import rooms

TEXT = (PROJECT / "docs" / "pipeline.md").read_text(encoding="utf-8")


def test_the_example_makes_a_data_set(tmp_path):
    for folder in ("maps", "bags/lobby", "bags/hall"):
        (tmp_path / folder).mkdir(parents=True)
    for name in ("lobby", "hall"):
        rooms.write_map(tmp_path / "maps" / f"{name}.yaml", rooms.room_map())
        rooms.write_labelme(tmp_path / "maps" / f"{name}.json", rooms.room_shapes())
    for name in ("first", "second"):
        room_drive(tmp_path / "bags" / "lobby", name, kind="ros1")
    room_drive(tmp_path / "bags" / "hall", "monday")
    (tmp_path / "hall_drop.txt").write_text("3\n")
    (tmp_path / "data.yaml").write_text(re.findall(r"```yaml\n(.*?)```", TEXT, re.DOTALL)[0])
    report = run_pipeline(read_config(tmp_path / "data.yaml"), Serial())
    assert report.published, str(report)
    data = open_dataset(str(tmp_path / "my-building"))
    assert [(entry.environment, entry.recording) for entry in data.sequences()] == [
        ("hall", "monday-morning"),
        ("lobby", "first"),
        ("lobby", "second"),
    ]
    assert sorted(data.manifest.splits) == ["block", "frame"]


def test_every_option_of_the_conversion_is_named():
    from conversion.options import Options

    given = {"environment", "recording", "license"}
    assert not [name for name in Options.__dataclass_fields__.keys() - given if name not in TEXT]
