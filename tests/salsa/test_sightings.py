from pathlib import Path

from salsa.sightings import Sightings, sighting_files


def test_paths_are_whole_once_resolved_and_streams_stay_names(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    found = Sightings(Path("camera.yaml"), "seen.json", Path("names.yaml")).resolved()
    assert found.camera == tmp_path.resolve() / "camera.yaml"
    assert found.detections == str(tmp_path.resolve() / "seen.json")
    assert found.names == tmp_path.resolve() / "names.yaml"
    assert Sightings(Path("camera.yaml"), "stream:seen").resolved().detections == "stream:seen"


def test_every_file_that_is_read_is_told(tmp_path):
    assert sighting_files(None) == {}
    (tmp_path / "camera.yaml").write_text("camera_info: ost.yaml", encoding="utf-8")
    found = sighting_files(Sightings(tmp_path / "camera.yaml", "stream:seen", tmp_path / "n.yaml"))
    assert found == {
        "camera": tmp_path / "camera.yaml",
        "camera_info": tmp_path / "ost.yaml",
        "detection_names": tmp_path / "n.yaml",
    }
