"""The page in a real browser: what a reader sees, clicks, types and copies."""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from cavbench.leaderboard.page.write import write
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.records import reading
from cavbench.statistics.estimates import share_interval
from tests.tree import ROOT

Open = Callable[..., Any]


@pytest.fixture
def opened(browser: Any, site: Path) -> Iterator[Open]:
    """The page, opened from disk without a network: opened(width=360, ...) -> Playwright's page. Errors on its console fail."""
    contexts, errors = [], []

    def call(at: str = "", **options: Any) -> Any:
        options.setdefault("viewport", {"width": 1280, "height": 900})
        context = browser.new_context(offline=True, **options)
        context.grant_permissions(["clipboard-read", "clipboard-write"])
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(5000)
        page.on(
            "console", lambda message: errors.append(message.text) if message.type in ("error", "warning") else None
        )
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on(
            "request",
            lambda request: None if request.url.startswith(("file:", "data:")) else errors.append(request.url),
        )
        page.goto(f"{(site / 'leaderboard.html').as_uri()}{at}")
        return page

    yield call
    for context in contexts:
        context.close()
    assert errors == []


def texts(page: Any, selector: str) -> list[str]:
    return [text.strip() for text in page.locator(selector).all_inner_texts()]


def column(page: Any, table: str, number: int) -> list[str]:
    return texts(page, f"#{table} tbody tr td:nth-child({number})")


def test_the_page_is_one_file_of_at_most_three_megabytes(site: Path) -> None:
    text = (site / "leaderboard.html").read_text()
    assert len(text.encode()) < 3e6
    assert "http://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert "src=" not in text, "a film is loaded when its card is opened, and is not needed"


def test_rows_are_in_rank_groups_with_their_flags_and_the_baselines_below(opened: Open) -> None:
    page = opened()
    assert column(page, "ranks", 2)[-3:] == ["best blind policy", "random", "IDM and MOBIL"]
    ranks = [int(text) for text in column(page, "ranks", 1) if text]
    assert ranks == sorted(ranks)
    row = page.locator("#ranks tr:has(a:text-is('masked'))")
    mark = row.locator(".mark")
    assert "an attack without gradients beats those with them" in mark.get_attribute("title")
    assert not page.locator(".tip:popover-open").count()
    mark.click()
    tip = page.locator(".tip:popover-open")
    assert "(with gradients)" in tip.locator("li", has_text="masked gradients").inner_text()
    box = tip.bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= 1280
    page.keyboard.press("Escape")
    assert not page.locator(".tip:popover-open").count()


def test_measures_of_decoys_stand_beside_the_scores_of_detectors_only(opened: Open) -> None:
    headings = {track: texts(opened(f"#/{track}"), "#ranks th") for track in ("driving", "detection")}
    for name, value in (("AP of stop", "0.83"), ("False stops", "0.27")):
        assert not any(text.startswith(name) for text in headings["driving"])
        place = next(n for n, text in enumerate(headings["detection"]) if text.startswith(name))
        assert set(column(opened("#/detection"), "ranks", place + 1)) == {value}


def test_a_heading_sorts_up_and_down_by_mouse_and_by_keyboard(opened: Open) -> None:
    page = opened()
    heading = page.locator("#pairs th", has_text="Safe progress")
    assert heading.get_attribute("aria-sort") == "none"
    heading.locator("button").click()
    assert heading.get_attribute("aria-sort") == "descending"
    falling = [float(text.split()[0]) for text in column(page, "pairs", 5)]
    assert falling == sorted(falling, reverse=True)
    page.keyboard.press("Enter")
    assert heading.get_attribute("aria-sort") == "ascending"
    assert column(page, "pairs", 5)[0].startswith(f"{min(falling):.2f}")


def test_a_phone_sorts_its_cards(opened: Open) -> None:
    page = opened(viewport={"width": 360, "height": 740})
    page.locator("#sort-ranks").select_option("-Clean")
    shown = [float(text) for text in texts(page, "#ranks td[data-label=Clean]") if text not in ("", "—")]
    assert len(shown) > 2
    assert shown == sorted(shown, reverse=True)
    assert page.evaluate("location.hash").endswith("sort=-Clean")
    page.locator("#sort-ranks").select_option("")
    assert "sort" not in page.evaluate("location.hash")
    assert not opened().locator("#sort-ranks").is_visible(), "headings sort where there is room for them"


def test_filters_choose_rows_and_compute_scores_again_from_the_cells_that_are_left(opened: Open, site: Path) -> None:
    page = opened()
    (board, *_), _ = read_boards(reading.read_all(site / "results"))
    worst = next(row.worst for row in board.rows if row.identity["defense"] == "advtrain")
    clear = [n for n, cell in enumerate(worst.cells) if cell.weather == "clear"]
    shown = page.locator("#ranks tr", has_text="advtrain").locator("td").nth(3)
    for value in ("rain", "fog"):
        page.locator(f"input[name=weather][value={value}]").uncheck()
    expected = share_interval(worst.scores[:, clear])
    bounds = f"{expected.low:.2f}–{expected.high:.2f}".replace("0.", ".")
    assert shown.inner_text() == f"{expected.estimate:.2f} {bounds}"
    assert "No interval" not in page.locator("#scope").inner_text()
    page.locator("input[name=density][value='2']").uncheck()
    assert "3 of 18 cells" in page.locator("#scope").inner_text()
    assert "No interval was computed for these cells together" in page.locator("#scope").inner_text()
    sparse = [n for n in clear if worst.cells[n].density == 1]
    assert shown.inner_text().strip() == f"{worst.scores[:, sparse].mean():.2f}", (
        "a mean, and no interval that nobody computed"
    )
    assert texts(page, "#heat thead th") == ["Lanes × density", "clear"]
    page.locator("#defense").select_option("advtrain")
    assert set(column(page, "pairs", 2)) == {"advtrain"}
    page.locator("#attack").select_option("pgd")
    assert len(column(page, "pairs", 1)) == 1
    page.get_by_role("button", name="Reset").click()
    assert "18 of 18 cells" in page.locator("#scope").inner_text()


def test_crashes_and_queries_are_those_of_the_cells_that_are_left(opened: Open, site: Path) -> None:
    page = opened()
    made = json.loads((site / "leaderboard.json").read_text())
    (pair,) = (
        pair for pair in made["pairs"] if (pair["attack"]["name"], pair["defense"]["name"]) == ("pgd", "advtrain")
    )
    page.locator("#defense").select_option("advtrain")
    page.locator("#attack").select_option("pgd")
    shown = []
    for weathers in (("clear", "rain", "fog"), ("clear", "rain"), ("clear",)):
        if len(weathers) < 3:
            page.locator(f"input[name=weather][value={('fog', 'rain')[2 - len(weathers)]}]").uncheck()
        cells = [cell for cell in pair["cells"] if cell["cell"]["weather"] in weathers]
        crashed, queries = (sum(cell[name] for cell in cells) / len(cells) for name in ("failed", "queries"))
        shown += column(page, "pairs", 7)
        assert shown[-1] == f"{100 * crashed:.0f} %"
        assert column(page, "pairs", 9) == [f"{queries:.0f}"]
    assert len(set(shown)) > 1


def test_a_pair_that_was_driven_in_some_cells_says_so(opened: Open) -> None:
    page = opened()
    attacks = texts(page, "#matrix thead th")
    assert attacks[:2] == ["Defence · victim", "no attack"]
    assert attacks[-1] == "pgd steps=30", "the usual settings go by the name alone, and what few rows have comes last"
    assert next(text for text in column(page, "matrix", len(attacks)) if text).endswith("2 of 18 cells")
    assert sum("of 18 cells" in text for text in column(page, "pairs", 5)) == 1
    page.locator("input[name=weather][value=rain]").uncheck()
    assert sum("2 of 12 cells" in text for text in column(page, "pairs", 5)) == 1


def test_no_cell_left_is_said_and_breaks_nothing(opened: Open) -> None:
    page = opened()
    for value in ("clear", "rain", "fog"):
        page.locator(f"input[name=weather][value={value}]").uncheck()
    assert "No row was driven" in page.locator("#scope").inner_text()


def test_the_heat_map_shows_the_pair_that_was_chosen(opened: Open) -> None:
    page = opened()
    assert page.locator("#heat tbody tr").count() == 6
    before = texts(page, "#heat td")
    choice = page.locator("#shown option", has_text="none · dqn: no attack").first.get_attribute("value")
    page.locator("#shown").select_option(choice)
    after = texts(page, "#heat td")
    assert len(after) == 18
    assert after != before
    colours = page.locator("#heat td").evaluate_all(
        "cells => cells.map(cell => getComputedStyle(cell).backgroundColor)"
    )
    assert len(set(colours)) > 5


def test_a_row_opens_its_card_and_its_recording_is_there(opened: Open, site: Path) -> None:
    page = opened()
    page.locator("#pairs tr:has(a[href$='.rrd']) a", has_text="zo").first.click()
    card = page.locator("#card")
    card.wait_for()
    for words in (
        "zo-none-dqn",
        "ab" * 32,
        "bench run attack=zo threat.norm=relative",
        "bench view zo-none-dqn",
        "training seeds",
    ):
        assert words in card.inner_text()
    link = card.locator("a[href$='.rrd']").get_attribute("href")
    assert (site / link).is_file()
    page.keyboard.press("Escape")
    # The dialog tells of its end later, and the address follows.
    page.wait_for_function("location.hash === '#/driving/relative-0.1'")
    assert not card.is_visible()
    address = "#/driving/relative-0.1/none+dqn/zo-none-dqn"
    assert "bench view zo-none-dqn" in opened(at=address).locator("#card").inner_text()


def test_an_address_holds_the_tab_the_filters_and_the_sort(opened: Open) -> None:
    page = opened()
    page.get_by_role("button", name="Driving").click()
    page.locator("#threat").select_option("1")
    page.locator("input[name=weather][value=rain]").uncheck()
    page.locator("#defense").select_option("advtrain")
    page.locator("#ranks th", has_text="Clean").locator("button").click()
    address = page.evaluate("location.hash")
    assert address == "#/driving/relative-0.05?defense=advtrain&weather=clear,fog&sort=-Clean"
    again = opened(at=address)
    for selector in ("#scope", "#ranks", "#heat", "#matrix", "#pairs"):
        assert again.locator(selector).inner_text() == page.locator(selector).inner_text()
    assert again.evaluate("location.hash") == address


def test_a_row_has_an_address_a_citation_and_the_papers(opened: Open) -> None:
    page = opened()
    page.locator("#ranks a", has_text="advtrain").first.click()
    assert page.evaluate("location.hash").startswith("#/driving/relative-0.1/advtrain")
    card = opened(at=page.evaluate("location.hash")).locator("#card")
    text = card.inner_text()
    for words in (
        "@misc{cavbench-advtrain",
        "Madry et al. 2018",
        "ab" * 32,
        "bench run attack=",
        "#/driving/relative-0.1/advtrain",
    ):
        assert words in text, words
    assert opened(at="#/nothing/like/this").locator("#board").is_visible()
    assert not opened(at="#/driving/relative-0.1/nobody").locator("#card").is_visible()


def test_the_card_of_a_row_shows_its_film(browser: Any, site: Path, tmp_path: Path) -> None:
    folder = tmp_path / "site"
    shutil.copytree(site, folder)
    text = (folder / "leaderboard.html").read_text()
    (folder / "film.webp").write_bytes((ROOT / "leaderboard" / "clips" / "relative-0.1-none+dqn.webp").read_bytes())
    (folder / "leaderboard.html").write_text(text.replace('"clip":null', '"clip":"film.webp"'))
    page = browser.new_page()
    page.goto((folder / "leaderboard.html").as_uri())
    page.locator("#ranks a[aria-label^=Film]").first.click()
    page.wait_for_function("document.querySelector('#card img')?.naturalWidth > 100")
    page.close()


def test_numbers_are_copied_as_csv_and_as_latex(opened: Open) -> None:
    page = opened()
    page.locator("[data-table=ranks] button", has_text="CSV").click()
    lines = list(csv.DictReader(io.StringIO(page.evaluate("navigator.clipboard.readText()"))))
    assert [line["Defence"] for line in lines] == column(page, "ranks", 2)
    assert all(
        float(line["Worst case low"]) <= float(line["Worst case"]) <= float(line["Worst case high"]) for line in lines
    )
    assert {"Crashed low", "Worst cell high", "Clean low"} <= set(lines[0])
    assert f"{float(lines[0]['Worst case']):.2f}" == column(page, "ranks", 4)[0].split()[0]
    assert page.locator("#said").inner_text() == "CSV copied"
    page.locator("[data-table=ranks] button", has_text="LaTeX").click()
    ranks = page.evaluate("navigator.clipboard.readText()")
    best = page.locator("#ranks tr.best").count()
    assert 0 < best == ranks.count("\\textbf{") < page.locator("#ranks tbody tr").count()
    assert "{\\scriptsize [" in ranks
    page.locator("[data-table=matrix] button", has_text="LaTeX").click()
    latex = page.evaluate("navigator.clipboard.readText()")
    assert latex.startswith("\\begin{tabular}{ll")
    assert latex.count("\\\\") == 1 + page.locator("#matrix tbody tr").count()


def test_both_tracks_the_thesis_and_the_threat_models_can_be_chosen(opened: Open) -> None:
    page = opened()
    page.locator("#threat").select_option("1")
    assert "relative 0.05" in page.locator("#scope").inner_text()
    page.get_by_role("button", name="Detection").click()
    assert column(page, "ranks", 3)[:2] == ["yolov3_tiny", "yolov3_tiny"]
    page.locator("footer a").click()
    assert not page.locator("#board").is_visible()
    assert any("Table 4.1" in title for title in texts(page, "#thesis h3"))
    page.get_by_role("button", name="How to read this").click()
    assert "without gradients" in page.locator("#method").inner_text()


def test_one_plot_has_a_line_for_each_defended_victim(opened: Open) -> None:
    page = opened()
    figures = page.locator("#curves figure")
    assert figures.count() == 2, "one against the budget, one against the effort"
    assert len(texts(page, "#curves figure:first-child .key li")) == 4
    # Without an attack, and at two budgets.
    assert page.locator("#curves figure:first-child svg[role=img] circle").count() == 4 * 3
    ticks = [float(text) for text in page.locator("#curves figure:first-child text.tick").all_text_contents()]
    assert ticks == [0, 0.05, 0.1]
    for text in page.locator("#curves text.tick").all_text_contents():
        assert float(f"{float(text):.0e}") == float(text), f"{text} is no round number"


@pytest.mark.parametrize("track", ["driving", "detection", "thesis", "method"])
@pytest.mark.parametrize("width", [360, 390, 768, 1280, 1920])
def test_nothing_is_wider_than_the_screen(opened: Open, track: str, width: int) -> None:
    page = opened(at=f"#/{track}", viewport={"width": width, "height": 740})
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    if width == 360 and track == "driving":
        # The ranking is shown as cards: nothing to scroll sideways.
        assert page.evaluate("document.getElementById('ranks').scrollWidth") <= 360
        assert page.locator("#ranks tr").nth(1).locator("td").nth(3).is_visible()
        page.locator("#pairs a").first.click()
        box = page.locator("#card").bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 360


def test_a_ranking_of_twenty_rows_is_on_one_screen_of_a_laptop(browser: Any, published_site: Path) -> None:
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto((published_site / "index.html").as_uri())
    for track in ("Driving", "Detection"):
        page.get_by_role("button", name=track).click()
        rows = page.locator("#ranks tbody tr:not(.baseline)")
        assert rows.count() >= 17
        last = rows.last.bounding_box()
        assert last["y"] + last["height"] <= 900
        assert page.evaluate("(e => e.scrollWidth <= e.clientWidth)(document.querySelector('.scroll:has(#ranks)'))")
    page.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [390, 768, 1280, 1920])
def test_axe_finds_nothing(browser: Any, site: Path, width: int, scheme: str) -> None:
    axe = pytest.importorskip(
        "axe_playwright_python.sync_playwright", reason="axe is not installed: pip install -e '.[dev]'"
    )
    # The page's own policy would refuse the script of the test.
    context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, bypass_csp=True)
    page = context.new_page()
    for track in ("driving", "detection", "thesis", "method"):
        page.goto(f"{(site / 'leaderboard.html').as_uri()}#/{track}")
        page.reload()
        assert axe.Axe().run(page).violations_count == 0, axe.Axe().run(page).generate_report()
    page.goto(f"{(site / 'leaderboard.html').as_uri()}#/driving")
    page.reload()
    page.locator("#ranks .mark").first.click()
    assert axe.Axe().run(page).violations_count == 0
    page.keyboard.press("Escape")
    page.locator("#ranks a").first.click()
    page.locator("#card").wait_for()
    assert axe.Axe().run(page).violations_count == 0
    context.close()


def test_attacks_are_ranked_below_the_victims(opened: Open, site: Path) -> None:
    page = opened()
    made = json.loads((site / "leaderboard.json").read_text())["boards"][0]["attackers"]
    assert [text.split()[0] for text in column(page, "attackers", 2)] == [one["name"] for one in made]
    assert [float(text) for text in column(page, "attackers", 3)] == pytest.approx(
        [one["added"] for one in made], abs=0.0051
    )


def test_ones_own_rows_are_marked(browser: Any, site: Path, tmp_path: Path) -> None:
    records = reading.read_all(site / "results")
    write(site / "results", tmp_path / "beside.html", Console(quiet=True), published=records)
    page = browser.new_page()
    page.goto((tmp_path / "beside.html").as_uri())
    mine, all_rows = page.locator("#ranks tr.mine"), page.locator("#ranks tbody tr:not(.baseline)")
    assert 0 < mine.count() == all_rows.count() / 2
    assert all("yours" in text for text in mine.all_inner_texts())
    mine.first.locator("a").first.click()
    assert page.evaluate("decodeURIComponent(location.hash)").startswith("#/driving/relative-0.1/yours:")
    page.close()


def test_links_lead_to_the_documentation_where_it_has_an_address(browser: Any, site: Path, tmp_path: Path) -> None:
    text = (site / "leaderboard.html").read_text()
    assert '"docs":""' in text, "there is no public address yet"
    (tmp_path / "page.html").write_text(text.replace('"docs":""', '"docs":"../"'))
    page = browser.new_page()
    page.goto((tmp_path / "page.html").as_uri())
    assert page.locator("#links a").all_inner_texts() == ["Documentation", "How rows are ranked", "Hand in a row"]
    page.locator("#ranks a", has_text="advtrain").first.click()
    page.locator("#card").wait_for()
    links = [one.get_attribute("href") for one in page.locator("#card .links a").all()]
    assert "../defenses/advtrain.html" in links
    assert any("Mnih%20et%20al.%202015" in link for link in links)
    assert "`" not in page.locator("#card").inner_text()
    page.close()


def test_the_keyboard_reaches_everything_and_shows_where_it_is(opened: Open) -> None:
    page = opened()
    seen = set()
    for _ in range(40):
        page.keyboard.press("Tab")
        seen.add(
            page.evaluate(
                "document.activeElement.id || document.activeElement.name || document.activeElement.innerText"
            )
        )
        assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
    assert {"Detection", "threat", "weather", "Copy CSV", "Worst case"} <= seen


CONTRAST = """() => {
  const linear = (c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
  const parts = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const level = (colour) => parts(colour).slice(0, 3).map((c) => linear(c / 255))
    .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
  const paper = (e) => {
    for (; e; e = e.parentElement) {
      const colour = getComputedStyle(e).backgroundColor;
      if (parts(colour)[3] !== 0) return level(colour);
    }
    return 1;
  };
  return [...document.querySelectorAll("p, td, th, a, b, small, button, legend, label, li, dt, dd, code, summary, text")]
    .filter((e) => e.getClientRects().length && e.textContent.trim() && !e.closest(".skip"))
    .map((e) => [level(e.tagName === "text" ? getComputedStyle(e).fill : getComputedStyle(e).color), paper(e)])
    .map(([ink, ground]) => (Math.max(ink, ground) + 0.05) / (Math.min(ink, ground) + 0.05))
    .reduce((a, b) => Math.min(a, b));
}"""


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1280])
def test_text_is_legible_in_light_and_in_dark(opened: Open, scheme: str, width: int) -> None:
    page = opened(color_scheme=scheme, viewport={"width": width, "height": 800})
    assert page.evaluate(CONTRAST) >= 4.5
    page.locator("#ranks a").first.click()
    page.locator("#card").wait_for()
    assert page.evaluate(CONTRAST) >= 4.5


def test_no_other_script_runs_and_nothing_is_sent(browser: Any, site: Path) -> None:
    page = browser.new_context(offline=True).new_page()
    page.goto((site / "leaderboard.html").as_uri())
    refused = page.evaluate(
        """async () => {
            const refused = [];
            document.addEventListener("securitypolicyviolation", (event) => refused.push(event.effectiveDirective));
            const script = document.createElement("script");
            script.textContent = "window.obeyed = true";
            document.body.append(script);
            document.body.insertAdjacentHTML("beforeend", "<p id='p' onclick='window.obeyed = true' style='top: 0'>");
            document.getElementById("p").click();
            await fetch("https://example.org/").catch(() => {});
            await new Promise((done) => setTimeout(done, 300));
            return [window.obeyed === undefined, ...refused];
        }"""
    )
    assert refused[0] is True
    assert {"script-src-elem", "script-src-attr", "style-src-attr", "connect-src"} <= set(refused[1:])
