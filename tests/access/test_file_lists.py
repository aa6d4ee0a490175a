import hashlib

import pytest

from semantic2d_dataset.access import web
from semantic2d_dataset.access.download import download
from semantic2d_dataset.access.file_lists import is_safe_name, list_files
from semantic2d_dataset.access.known_datasets import HuggingFaceFolder, KnownDataset, ZenodoRecord
from semantic2d_dataset.access.web import new_session
from semantic2d_dataset.errors import DownloadError
from tests.access import hosts
from tests.access.hosts import md5

LARGE, PLAIN = b"large" * 100, b"plain"
TREE = "/api/datasets/team/data/tree/main/dataset?recursive=true"


@pytest.fixture
def host(monkeypatch):
    monkeypatch.setattr(web, "RETRIES", 0)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    made = hosts.Host({"a b.zip": LARGE, "raw/plain.txt": PLAIN})
    yield made
    made.close()


def listed(source):
    with new_session() as session:
        return list_files(session, source)


def tree():
    blob = hashlib.sha1(b"blob 5\0" + PLAIN).hexdigest()
    sha256 = hashlib.sha256(LARGE).hexdigest()
    return [
        {"type": "directory", "oid": "0" * 40, "size": 0, "path": "dataset/raw"},
        {"type": "file", "oid": blob, "size": 5, "path": "dataset/raw/plain.txt"},
        {"type": "file", "oid": blob, "size": 5, "path": "dataset/.gitattributes"},
        {
            "type": "file",
            "oid": "1" * 40,
            "size": 500,
            "path": "dataset/a b.zip",
            "lfs": {"oid": sha256, "size": 500, "pointerSize": 128},
        },
    ]


def test_record_is_listed_with_the_address_that_serves_ranges_first(host):
    first, second = listed(ZenodoRecord("7", host.url))
    assert (first.name, first.size, first.checksum) == ("a b.zip", 500, md5(LARGE))
    assert first.urls == (
        f"{host.url}/records/7/files/a%20b.zip",
        f"{host.url}/api/records/7/files/a b.zip/content",
    )
    assert second.name == "raw/plain.txt"


def test_folder_of_a_repository_is_listed_over_pages_and_fetched(host, tmp_path):
    def first_page(handler, body, offset):
        link = f'<{host.url}{TREE}&cursor=x>; rel="next"'
        hosts.start(handler, 200, len(body), Link=link)
        handler.wfile.write(body)

    host.pages[TREE], host.pages[f"{TREE}&cursor=x"] = tree()[:2], tree()[2:]
    source = HuggingFaceFolder("team/data", "dataset", host=host.url)
    host.list_moods = [first_page]
    assert [(f.name, f.checksum.partition(":")[0]) for f in listed(source)] == [
        ("a b.zip", "sha256"),
        ("raw/plain.txt", "git"),
    ]
    host.list_moods = [first_page]
    download(KnownDataset("d", "1", "D", "unknown", (source,)), tmp_path)
    assert (tmp_path / "raw" / "plain.txt").read_bytes() == PLAIN
    assert (tmp_path / "a b.zip").read_bytes() == LARGE


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("a.zip", True),
        ("raw/a b.bag", True),
        ("ä.zip", True),
        ("../a", False),
        ("a/../../b", False),
        ("/etc/passwd", False),
        ("a//b", False),
        ("", False),
        (".hidden", False),
        ("..", False),
        ("C:\\a", False),
        ("a\nb", False),
        ("a ", False),
    ],
)
def test_name_cannot_leave_its_folder(name, safe):
    assert is_safe_name(name) is safe


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"key": "../a"}, "refused a file named"),
        ({"key": "/a"}, "refused a file named"),
        ({"key": 3}, "not a list of files"),
        ({"key": "RAW"}, "two files have one name"),
        ({"size": -1}, "without a size"),
        ({"size": "5"}, "without a size"),
        ({"size": True}, "without a size"),
        ({"checksum": "crc:1"}, "without a size and a digest"),
        ({"checksum": None}, "without a size and a digest"),
        ({"links": {}}, "not a list of files"),
        ({"links": {"self": "file:///etc/passwd"}}, "leads to file"),
    ],
)
def test_wrong_lists_are_refused(change, message, host):
    said = host.record()
    said["files"][0] |= change
    host.pages["/api/records/7"] = said
    with pytest.raises(DownloadError, match=message):
        listed(ZenodoRecord("7", host.url))


@pytest.mark.parametrize("said", [[], None, {"files": None}, {"files": [3]}, "text", {}])
def test_other_answers_are_no_lists(said, host):
    host.pages["/api/records/7"] = said
    with pytest.raises(DownloadError, match="not a list of files"):
        listed(ZenodoRecord("7", host.url))
