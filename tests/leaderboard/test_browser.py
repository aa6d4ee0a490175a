"""The pages in a real browser: sorting, filtering, links, contrast, names, and no request outside.

They run where Chromium and playwright are: ``pip install '.[browser]'`` and Debian's ``chromium``.
"""

import contextlib
import functools
import http.server
import json
import shutil
import threading

import pytest

from leaderboard.adding import add_entry
from leaderboard.at_hand import AtHand
from leaderboard.entries import to_json
from leaderboard.published import published_entries
from leaderboard.site import build_site
from tests.browsers import CHECK, launched
from tests.leaderboard.boards import add, with_extras


@pytest.fixture(scope="module")
def site(tmp_path_factory, dataset_folder, predictions_folder, entry_of_seeds, seeds_folder):
    """Pages with every kind of row."""
    folder = tmp_path_factory.mktemp("site")
    entries = folder / "entries"
    entries.mkdir()
    for path in sorted(predictions_folder.iterdir()):
        add(path, dataset_folder, entries, kind="sanity" if path.stem == "good" else "scored")
    poor = next(entries.glob("*poor.json"))
    poor.write_text(to_json(with_extras(json.loads(poor.read_text()))))
    shutil.copytree(predictions_folder, folder / "predictions")
    (folder / "predictions" / "poor.h5").unlink()  # what was added is not scored again
    shutil.copytree(seeds_folder, folder / "predictions" / "seeds")
    for entry in (entry_of_seeds, *published_entries()):
        add_entry(entry, entries)
    build_site(folder / "pages", entries, AtHand([str(dataset_folder)], folder / "predictions"))
    return folder / "pages"


@pytest.fixture(scope="module")
def address(site):
    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *args):
            pass

    handler = functools.partial(Handler, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture(scope="module")
def browser():
    with launched() as found:
        yield found


@contextlib.contextmanager
def opened(browser, address, **options):
    """A page that fails on anything that the console says and on any request outside."""
    context = browser.new_context(**options)
    said = []
    page = context.new_page()
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda r: r.url.startswith((address, "file:")) or said.append(r.url))
    page.on("response", lambda r: r.status < 400 or said.append(f"{r.status} {r.url}"))
    page.goto(f"{address}/index.html")
    yield page
    context.close()
    assert not [text for text in said if "favicon" not in text]


def names_of(page):
    return page.locator("section.track:visible tbody tr:visible th a").all_inner_texts()


def test_columns_sort_by_mouse_and_by_keyboard(browser, address):
    with opened(browser, address) as page:
        assert names_of(page) == ["Good", "Net", "Fair", "Poor"]
        header = page.locator("section.track:visible thead th", has_text="mIoU")
        assert header.get_attribute("aria-sort") == "descending"
        header.get_by_role("button").click()
        assert header.get_attribute("aria-sort") == "ascending"
        assert names_of(page) == ["Poor", "Fair", "Net", "Good"]
        method = page.locator("section.track:visible thead th", has_text="Method")
        method.get_by_role("button").focus()
        page.keyboard.press("Enter")
        assert names_of(page) == ["Fair", "Good", "Net", "Poor"]
        assert header.get_attribute("aria-sort") is None
        page.locator("section.track:visible thead th", has_text="Rank").locator("button").click()
        assert names_of(page)[:2] == ["Net", "Fair"]  # what has no rank comes last


def test_rows_are_filtered_by_words_and_by_rank(browser, address):
    with opened(browser, address) as page:
        page.get_by_label("Filter").fill("unverified")
        assert names_of(page) == ["Poor"]
        assert page.get_by_role("status").inner_text() == "1 of 4 rows"
        page.get_by_label("Filter").fill("3 seeds")
        assert names_of(page) == ["Net"]
        page.get_by_label("Filter").fill("")
        page.get_by_label("Ranked rows only").check()
        assert names_of(page) == ["Net", "Fair"]


def test_figures_by_class_change_with_the_choice(browser, address):
    with opened(browser, address) as page:
        cell = page.locator("section.track:visible tbody tr").first.locator("td.iou").first
        assert cell.is_visible()
        page.get_by_label("CA by class").check()
        assert not cell.is_visible()


def test_a_track_is_chosen_and_linked_to(browser, address):
    with opened(browser, address) as page:
        assert page.locator("section.track:visible").count() == 1
        page.get_by_label("Track", exact=True).select_option(index=1)
        assert len(names_of(page)) == 17
        there = page.url
        page.goto("about:blank")
        page.goto(there)
        assert len(names_of(page)) == 17


def test_every_link_between_pages_leads_to_a_page(browser, address, site):
    with opened(browser, address) as page:
        seen, waiting = set(), [f"{address}/index.html"]
        while waiting:
            page.goto(waiting.pop())
            links = page.eval_on_selector_all("a[href]", "all => all.map(a => a.href)")
            for link in links:
                plain = link.partition("#")[0]
                if not plain.startswith(address) or plain in seen:
                    continue
                seen.add(plain)
                waiting.append(plain)
        assert len(seen) == len(list(site.rglob("*.html")))


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1280, 390])
def test_everything_can_be_read_and_has_a_name(browser, address, site, width, scheme):
    size = {"width": width, "height": 800}
    names = [p.relative_to(site).as_posix() for p in sorted(site.rglob("*.html"))]
    shown = [n for n in names if "as-published" not in n or "ipa" in n or "legs" in n]
    with opened(browser, address, viewport=size, color_scheme=scheme) as page:
        for name in shown:
            page.goto(f"{address}/{name}")
            assert page.evaluate(CHECK) == [], name


def test_without_script_every_table_is_there(browser, address):
    with opened(browser, address, java_script_enabled=False) as page:
        assert len(names_of(page)) == 21
        assert not page.get_by_label("Filter").is_visible()
        page.get_by_role("link", name="as published, test of frame").first.click()
        assert "#" in page.url


def test_keyboard_reaches_the_content_first_and_focus_is_seen(browser, address):
    with opened(browser, address) as page:
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.textContent") == "Skip to the content"
        outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        assert outline == "solid"


def test_headings_repeated_on_paper_are_text_since_buttons_would_be_blank(browser, address):
    with opened(browser, address) as page:
        page.emulate_media(media="print")
        shown = "getComputedStyle(document.querySelector('th button')).display"
        assert page.evaluate(shown) == "contents"


def test_print_shows_every_track_and_no_controls(browser, address):
    with opened(browser, address) as page:
        page.emulate_media(media="print")
        assert page.locator("section.track:visible").count() == 2
        assert not page.get_by_label("Filter").is_visible()
        assert page.pdf()[:5] == b"%PDF-"


def test_pages_work_as_files_without_a_server(browser, site):
    with opened(browser, site.as_uri()) as page:
        page.get_by_label("Filter").fill("fair")
        assert names_of(page) == ["Fair"]


def test_motion_is_left_out_where_it_is_not_wanted(browser, address):
    with opened(browser, address, reduced_motion="reduce") as page:
        style = "getComputedStyle(document.querySelector('a'))"
        assert page.evaluate(f"{style}.transitionDuration") == "0s"


def test_the_check_of_the_pages_finds_what_it_looks_for(browser, address):
    with opened(browser, address, color_scheme="light") as page:
        page.evaluate("document.querySelector('h1').style.color = '#888'")
        page.evaluate("document.querySelector('section button').textContent = ''")
        page.evaluate("document.querySelector('main').style.width = '3000px'")
        page.evaluate("document.querySelector('main').style.maxWidth = 'none'")
        found = page.evaluate(CHECK)
        for start in ("3.54: Leaderboard", "no name: <button", "wider than"):
            assert any(each.startswith(start) for each in found), found
