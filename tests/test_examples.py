"""The worked examples in docs/examples work as they stand there, on shorter recordings."""

import importlib.util
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from semantic2d_dataset import cli, load_dataset, open_dataset
from semantic2d_dataset.format.sequence import SequenceReader
from tests.conftest import PROJECT

EXAMPLES = PROJECT / "docs" / "examples"
SCRIPT = "docs/examples/make_recordings.py"
SCANS = {"ogm_turtlebot2.md": 200, "stata.md": 400}  # what stands still shows in 20 s


@pytest.fixture(scope="module")
def script():
    """The script of the examples, as a module."""
    name = "make_recordings"
    spec = importlib.util.spec_from_file_location(name, PROJECT / SCRIPT)
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    del sys.modules[name]


@pytest.fixture
def follow(script, monkeypatch, tmp_path):
    """Run the commands of a page one after another in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(main, words):
        monkeypatch.setattr(sys, "argv", words)
        with pytest.raises(SystemExit) as end:
            main()
        assert end.value.code in (0, None), words

    def follow_it(page):
        (yaml,) = re.findall(r"```yaml\n(.*?)```", text_of(page), re.DOTALL) or ("",)
        for words in commands_of(page):
            match words:
                case ["python", "docs/examples/make_recordings.py", "check", *_]:
                    run(script.app, words[1:])
                case ["python", "docs/examples/make_recordings.py", _, out]:
                    run(script.app, [*words[1:], "--scans", str(SCANS[page])])
                    Path(out, "data.yaml").write_text(yaml, encoding="utf-8")
                case ["semantic2d", *_]:
                    run(cli.main, words)
                case ["mkdir", "-p", folder]:
                    Path(folder).mkdir(parents=True)
                case _:
                    pytest.fail(f"{page}: no reader of this test runs {shlex.join(words)}")

    return follow_it


def text_of(page):
    return (EXAMPLES / page).read_text(encoding="utf-8")


def commands_of(page):
    for block in re.findall(r"```sh\n(.*?)```", text_of(page), re.DOTALL):
        for line in block.replace("\\\n", "").splitlines():
            yield shlex.split(line)


def run_python_of(page):
    for block in re.findall(r"```python\n(.*?)```", text_of(page), re.DOTALL):
        exec(block, {})


def test_the_lobby_of_34_pedestrians_is_labelled_by_its_page(follow, script, capsys):
    follow("ogm_turtlebot2.md")
    assert re.search(r"no class +0 ", capsys.readouterr().out)
    run_python_of("ogm_turtlebot2.md")
    folder = Path("ogm-example")
    for split in ("train", "val", "test"):
        found = script.compare(
            folder / "truth" / f"{split}.npz", folder / "labelled" / "sequences" / f"{split}.h5"
        )
        assert found["accepted"] >= 0.95 * found["scans"]
        assert found["worst_m"] < 0.05
        assert found["right"] >= 0.97
        assert found["person_iou"] >= 0.97
    data = open_dataset(str(folder / "labelled"))
    assert sorted(data.manifest.splits) == ["frame"]
    lengths = [
        len(load_dataset(folder / "labelled", lidar="turtlebot2-1080", split=s, scheme="frame"))
        for s in ("train", "val", "test")
    ]
    assert lengths == [140, 20, 40]
    assert (folder / "review.html").stat().st_size > 100_000


def test_the_bag_of_a_pr2_is_labelled_by_its_page(follow, script, capsys):
    follow("stata.md")
    assert re.search(r"no class +0 ", capsys.readouterr().out)
    folder = Path("stata-example")
    (truth,) = folder.glob("truth/*.npz")
    (published,) = folder.glob("data/sequences/*.h5")
    for labelled in (folder / "labelled.h5", published):
        found = script.compare(truth, labelled)
        assert found["accepted"] == found["scans"] == 400
        assert found["worst_m"] < 0.05
        assert found["right"] >= 0.97
        assert found["person_iou"] >= 0.9


def test_recordings_have_the_form_of_the_published_ones(script, tmp_path):
    from conversion.layouts.ogm import TURTLEBOT2

    assert script.TURTLEBOT2 == TURTLEBOT2
    script.ogm(tmp_path / "ogm", scans=20, seed=3)
    layout = tmp_path / "ogm" / "OGM-datasets" / "OGM-Turtlebot2"
    assert sorted(p.name for p in layout.iterdir()) == ["test", "train", "val"]
    assert sorted(p.name for p in (layout / "val").iterdir()) == [
        "positions",
        "scans",
        "velocities",
    ]
    assert (layout / "val" / "scans" / "val.txt").read_text() == "0000000.npy\n0000001.npy\n"
    scan = np.load(layout / "val" / "scans" / "0000001.npy", allow_pickle=False)
    assert scan.shape == (1080,)
    assert scan.max() <= 30.0
    assert np.isfinite(scan).all()


def test_a_seed_gives_the_same_recording(script, tmp_path):
    for name in ("one", "two"):
        script.stata(tmp_path / name, scans=20, seed=4)
    one, two = (
        {p.name: p.read_bytes() for p in (tmp_path / name).rglob("*") if p.is_file()}
        for name in ("one", "two")
    )
    assert one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []


def test_a_folder_that_exists_is_left_alone(script, tmp_path):
    with pytest.raises(Exception, match="name a folder that does not"):
        script.ogm(tmp_path)


def test_truth_of_another_recording_is_refused(script, tmp_path):
    from tests.generators import make_dataset

    make_dataset(tmp_path / "data")
    sequence = next((tmp_path / "data" / "sequences").glob("*.h5"))
    np.savez(tmp_path / "truth.npz", labels=np.zeros((1, 4), np.uint8), poses=np.zeros((1, 3)))
    with SequenceReader(sequence) as reader:
        assert len(reader) != 1
    with pytest.raises(Exception, match="is of 1 scans"):
        script.compare(tmp_path / "truth.npz", sequence)
