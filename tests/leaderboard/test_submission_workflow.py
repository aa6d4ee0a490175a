"""The recipe that scores pull requests: what it runs, and what it refuses."""

import os
import re
import shutil
import subprocess

import pytest
import yaml
from typer.testing import CliRunner

from leaderboard.cli import app
from tests.conftest import PROJECT

CI = PROJECT / "leaderboard" / "ci"


@pytest.fixture
def workflow():
    return yaml.safe_load((CI / "score-submission.yml").read_text())


def test_the_token_may_only_read(workflow):
    assert workflow["permissions"] == {"contents": "read"}
    assert all("permissions" not in job for job in workflow["jobs"].values())
    assert "secrets." not in (CI / "score-submission.yml").read_text()


def test_only_the_base_branch_is_checked_out(workflow):
    steps = workflow["jobs"]["score"]["steps"]
    (checkout,) = [step["with"] for step in steps if "checkout" in step.get("uses", "")]
    assert checkout["ref"] == "${{ github.event.pull_request.base.sha }}"
    assert checkout["persist-credentials"] is False
    for step in steps:
        assert not re.search(r"git (checkout|switch|merge|reset|pull)", step.get("run", ""))


def test_no_text_of_the_pull_request_stands_in_a_script(workflow):
    for step in workflow["jobs"]["score"]["steps"]:
        assert "${{" not in step.get("run", "")


def test_an_older_branch_with_older_scripts_is_no_way_in(workflow):
    assert workflow[True]["pull_request_target"]["branches"] == ["main"]  # "on" is true in YAML


def test_what_is_printed_of_a_submission_is_no_command_to_the_runner(workflow):
    runs = [step["run"] for step in workflow["jobs"]["score"]["steps"] if "run" in step]
    for run in runs:
        if "semantic2d" in run or "collect.sh" in run:
            assert run.startswith('echo "::stop-commands::$(cat /proc/sys/kernel/random/uuid)"\n')


def git(folder, *words):
    said = {"GIT_AUTHOR_NAME": "a", "GIT_AUTHOR_EMAIL": "a@a", "GIT_COMMITTER_NAME": "a"}
    said |= {"GIT_COMMITTER_EMAIL": "a@a", "GIT_CONFIG_GLOBAL": "/dev/null"}
    found = subprocess.run(
        ["git", *words], cwd=folder, env=os.environ | said, check=True, capture_output=True
    )
    return found.stdout.decode().strip()


@pytest.fixture
def repository(tmp_path):
    folder = tmp_path / "repository"
    (folder / "leaderboard" / "entries").mkdir(parents=True)
    (folder / "leaderboard" / "entries" / "d--old.json").write_text("{}")
    git(tmp_path, "init", "--quiet", "repository")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "-m", "base")
    return folder


def collect(folder, files, **environment):
    """Commit files by path, go back to the base, and collect what the commit adds."""
    base = git(folder, "rev-parse", "HEAD")
    for path, content in files.items():
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        if content is None:
            target.symlink_to("/etc/passwd")
        else:
            target.write_bytes(content)
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "-m", "head")
    head = git(folder, "rev-parse", "HEAD")
    git(folder, "reset", "--quiet", "--hard", base)
    return subprocess.run(
        [str(CI / "collect.sh"), base, head, str(folder.parent / "incoming")],
        cwd=folder,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_new_entries_and_predictions_are_taken_byte_for_byte(repository):
    content = bytes(range(256)) * 40
    files = {"leaderboard/entries/d--new.json": b"{}\n", "submissions/mine.h5": content}
    found = collect(repository, files)
    assert (found.returncode, found.stdout) == (0, "2 files collected\n")
    incoming = repository.parent / "incoming"
    assert (incoming / "predictions" / "mine.h5").read_bytes() == content
    assert (incoming / "entries" / "d--new.json").read_bytes() == b"{}\n"
    assert not (repository / "submissions").exists()


@pytest.mark.parametrize(
    ("path", "content", "message"),
    [
        ("leaderboard/site.py", b"import os", "adds entries and predictions only"),
        (".github/workflows/score.yml", b"on: push", "adds entries and predictions only"),
        ("leaderboard/entries/deep/x.json", b"{}", "adds entries and predictions only"),
        ("leaderboard/entries/x.py", b"x", "no entry"),
        ("leaderboard/entries/dataset.json", b"{}", "no entry"),
        ("submissions/x.json", b"{}", "no predictions"),
        ("submissions/$(touch pwned).h5", b"x", "not a name"),
        ("submissions/-rf.h5", b"x", "not a name"),
        ("submissions/a b\n.h5", b"x", "not a name"),
        ("leaderboard/entries/d--old.json", b"[]", "a maintainer must look"),
        ("submissions/link.h5", None, "not a plain file"),
        ("submissions/big.h5", b"x" * 5001, "5001 bytes"),
    ],
)
def test_anything_else_is_refused(repository, path, content, message):
    found = collect(repository, {path: content}, MOST_BYTES="5000")
    assert found.returncode == 1
    assert message in found.stderr
    assert not list((repository.parent / "incoming").rglob("*.*"))
    assert not (repository / "pwned").exists()


def test_of_a_submission_that_is_refused_nothing_stays(repository):
    found = collect(repository, {"submissions/a.h5": b"x", "submissions/b.h5": None})
    assert "submissions/b.h5: not a plain file" in found.stderr
    assert not (repository.parent / "incoming").exists()


def test_files_of_another_submission_are_not_scored_with_it(repository):
    stale = repository.parent / "incoming" / "predictions" / "stale.h5"
    stale.parent.mkdir(parents=True)
    stale.write_bytes(b"theirs")
    found = collect(repository, {"submissions/mine.h5": b"x"})
    assert (found.returncode, stale.read_bytes()) == (1, b"theirs")
    assert "is there already" in found.stderr


@pytest.mark.parametrize("hide", ["submodule", "executable", "folder link", "history"])
def test_no_trick_of_git_brings_in_anything_else(repository, hide):
    base = git(repository, "rev-parse", "HEAD")
    (repository / "submissions").mkdir()
    mine = repository / "submissions" / "a.h5"
    mine.write_bytes(b"x")
    if hide == "submodule":
        mine.unlink()
        git(repository, "update-index", "--add", "--cacheinfo", f"160000,{base},submissions/a.h5")
    elif hide == "executable":
        mine.chmod(0o755)
    elif hide == "folder link":
        shutil.rmtree(repository / "leaderboard")
        (repository / "leaderboard").symlink_to("/etc")
    elif hide == "history":
        git(repository, "checkout", "--quiet", "--orphan", "other")
    if hide != "submodule":
        git(repository, "add", "--all")
    git(repository, "commit", "--quiet", "-m", "head")
    out = repository.parent / "incoming"
    words = [str(CI / "collect.sh"), base, "HEAD", str(out)]
    assert subprocess.run(words, cwd=repository, capture_output=True, check=False).returncode != 0
    assert not out.exists()


@pytest.mark.parametrize("words", [[], ["HEAD"], ["HEAD", "HEAD"], ["HEAD"] * 4])
def test_wrong_usage_says_how(repository, words):
    found = subprocess.run(
        [str(CI / "collect.sh"), *words], cwd=repository, capture_output=True, check=False
    )
    assert (found.returncode, found.stderr) == (2, b"usage: collect.sh BASE HEAD OUT\n")


def test_many_files_are_refused(repository):
    files = {f"submissions/{n}.h5": b"x" for n in range(4)}
    assert "more than 3 files" in collect(repository, files, MOST_FILES="3").stderr


def test_commits_that_are_not_there_are_no_empty_submission(repository):
    words = [str(CI / "collect.sh"), "HEAD", "0" * 40, str(repository.parent / "incoming")]
    assert subprocess.run(words, cwd=repository, capture_output=True, check=False).returncode != 0


def test_a_submission_of_nothing_is_refused(repository):
    words = [str(CI / "collect.sh"), "HEAD", "HEAD", str(repository.parent / "incoming")]
    assert subprocess.run(words, cwd=repository, capture_output=True, check=False).returncode == 1


def test_every_command_of_the_recipe_exists(workflow):
    runs = "\n".join(step.get("run", "") for step in workflow["jobs"]["score"]["steps"])
    found = re.findall(r"semantic2d leaderboard (\w+)((?:\\\n|[^\n|;])*)", runs)
    assert [command for command, _ in found] == ["add", "fetch", "check", "check"]
    for command, options in found:
        said = CliRunner().invoke(app, [command, "--help"]).stdout
        for option in re.findall(r"--[a-z-]+", options):
            assert option in said, (command, option)
