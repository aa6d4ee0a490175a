import copy
import hashlib
from pathlib import Path

import pytest

from leaderboard.entries import Entry
from leaderboard.fetching import fetch_predictions
from leaderboard.published import published_entries
from semantic2d_dataset.errors import ChecksumError, DownloadError, InvalidInputError
from tests.access.hosts import Host, make_bytes

BODY = make_bytes(100_000)


@pytest.fixture
def host():
    found = Host({"p.h5": BODY})
    yield found
    found.close()


def entry_of(host, digest):
    url = f"{host.url}/records/7/files/p.h5"
    return Entry(Path("x.json"), {"predictions_url": url, "digests": {"predictions": digest}})


def test_predictions_are_got_once_and_named_by_their_digest(host, tmp_path):
    digest = hashlib.sha256(BODY).hexdigest()
    for _ in range(2):
        path = fetch_predictions(entry_of(host, digest), tmp_path, most_bytes=len(BODY))
        assert path == tmp_path / f"{digest}.h5"
        assert path.read_bytes() == BODY
    assert len(host.requests) == 1


def test_another_file_than_was_scored_is_refused(host, tmp_path):
    with pytest.raises(ChecksumError, match=r"digests\.predictions: expected 0000"):
        fetch_predictions(entry_of(host, "0" * 64), tmp_path, most_bytes=len(BODY))
    assert not list(tmp_path.iterdir())


def test_more_bytes_than_allowed_are_not_read(host, tmp_path):
    with pytest.raises(DownloadError, match="larger than the 5000 bytes"):
        fetch_predictions(entry_of(host, "0" * 64), tmp_path, most_bytes=5000)
    assert not list(tmp_path.iterdir())


def test_only_the_hosts_that_are_allowed_are_asked(host, tmp_path):
    with pytest.raises(InvalidInputError, match=r"127\.0\.0\.1 is none of zenodo\.org"):
        fetch_predictions(
            entry_of(host, "0" * 64), tmp_path, most_bytes=5000, hosts=("zenodo.org",)
        )
    assert host.requests == []


@pytest.mark.parametrize("url", ["https://{}\\@zenodo.org/p.h5", "https://{}\\.zenodo.org/p.h5"])
def test_no_way_to_write_an_address_gets_past_the_allowed_hosts(host, tmp_path, url):
    url = url.format(host.url.removeprefix("http://"))
    entry = Entry(Path("x.json"), {"predictions_url": url, "digests": {"predictions": "0" * 64}})
    with pytest.raises(InvalidInputError, match=r"127\.0\.0\.1 is none of zenodo\.org"):
        fetch_predictions(entry, tmp_path, most_bytes=5000, hosts=("zenodo.org",))
    assert host.requests == []


@pytest.mark.parametrize(
    "url", ["https://[", "https://a..b/", "https://:1/", "https://h:99999999/"]
)
def test_what_is_no_address_is_refused(tmp_path, url):
    entry = Entry(Path("x.json"), {"predictions_url": url, "digests": {"predictions": "0" * 64}})
    with pytest.raises(InvalidInputError, match="predictions_url"):
        fetch_predictions(entry, tmp_path, most_bytes=5000, hosts=("zenodo.org",))


@pytest.mark.parametrize("folder", [False, True])
def test_another_file_under_the_name_of_a_digest_is_not_taken_for_it(host, tmp_path, folder):
    place = tmp_path / f"{'0' * 64}.h5"
    place.mkdir() if folder else place.write_bytes(b"x")
    with pytest.raises(ChecksumError, match="not the file that its name says"):
        fetch_predictions(entry_of(host, "0" * 64), tmp_path, most_bytes=5000)
    assert host.requests == []


def test_an_entry_that_points_nowhere_gets_nothing(tmp_path):
    entry = Entry(Path("x.json"), {"digests": {"predictions": "0" * 64}})
    assert fetch_predictions(entry, tmp_path, most_bytes=1) is None


def test_predictions_of_every_seed_that_has_an_address_are_got(tmp_path, entry_of_seeds):
    said = copy.deepcopy(entry_of_seeds)
    bodies = [make_bytes(1000, seed) for seed in range(2)]
    host = Host({f"{n}.h5": body for n, body in enumerate(bodies)})
    for n, (run, body) in enumerate(zip(said["seeds"]["runs"], bodies, strict=False)):
        run["predictions"] = hashlib.sha256(body).hexdigest()
        run["url"] = f"{host.url}/records/7/files/{n}.h5"
    entry = Entry(Path("x.json"), said)
    found = [fetch_predictions(each, tmp_path, most_bytes=1000) for each in entry.files()]
    host.close()
    assert [path and path.read_bytes() for path in found] == [*bodies, None]


def test_a_published_row_has_no_predictions_to_get(tmp_path):
    assert list(Entry(Path("x.json"), next(published_entries())).files()) == []
