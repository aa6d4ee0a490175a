import pytest

from semantic2d_dataset.errors import InvalidInputError
from semantic2d_dataset.scene.documents import hint, read_yaml


def written(tmp_path, text):
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8")
    return tmp_path / "a.yaml"


def test_yaml_and_json_are_read_as_plain_values(tmp_path):
    assert read_yaml(written(tmp_path, "a: [1, 2.5]\nb: c")) == {"a": [1, 2.5], "b": "c"}
    assert read_yaml(written(tmp_path, '{"a": null}')) == {"a": None}
    assert read_yaml(written(tmp_path, "")) is None


def test_of_several_documents_the_first_is_read_where_that_is_wanted(tmp_path):
    path = written(tmp_path, "a: 1\n---\nb: 2\n---\n")
    assert read_yaml(path, several=True) == {"a": 1}
    with pytest.raises(InvalidInputError, match="a.yaml: not a YAML file"):
        read_yaml(path)


@pytest.mark.parametrize(
    "text",
    ["a: [", "\x00", "a: 2024-13-45", "!!python/object/apply:os.getcwd []", "? {a: 1}", "[" * 5000],
)
def test_what_is_no_yaml_is_our_error_in_one_line(text, tmp_path):
    with pytest.raises(InvalidInputError, match="a.yaml: not a camera: ") as told:
        read_yaml(written(tmp_path, text), kind="a camera")
    assert "\n" not in str(told.value)


def test_bytes_that_are_no_text_are_our_error_and_a_missing_file_is_python_s(tmp_path):
    (tmp_path / "a.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InvalidInputError, match="not a YAML file"):
        read_yaml(tmp_path / "a.yaml")
    with pytest.raises(FileNotFoundError):
        read_yaml(tmp_path / "none.yaml")


def test_an_unknown_word_is_told_what_was_meant_or_what_there_is():
    assert hint("pose", ["streams", "poses"]) == "; did you mean 'poses'?"
    assert hint(3, {"streams": 1, "poses": 2}) == "; known are poses, streams"


BOMB = "\n".join(
    ["a: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    + [f"b{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]
)


@pytest.mark.parametrize("text", [BOMB, "a: &a [1, *a]", "a: &a {b: [*a]}"])
def test_aliases_that_stand_for_too_much_are_refused(text, tmp_path):
    with pytest.raises(InvalidInputError, match="its aliases stand for more than 1,000,000 values"):
        read_yaml(written(tmp_path, text))


def test_aliases_are_read_where_they_save_writing(tmp_path):
    found = read_yaml(written(tmp_path, "a: &a {b: [1]}\nc: *a\nd: [*a, *a]"))
    assert found == {"a": {"b": [1]}, "c": {"b": [1]}, "d": [{"b": [1]}, {"b": [1]}]}
