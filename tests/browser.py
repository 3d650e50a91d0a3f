"""The page of a run in a browser, on a phone and on a desk.

    container/check-browser

runs this twice in the environment, to make pages and to judge what a browser has measured on them,
and the browser between that where it is. Where there is one in the environment, the tests do it.
"""

import html
import json
import re
import sys
from pathlib import Path

WIDTHS = (390, 1280)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync "
    "--allow-file-access-from-files --window-size=1400,900 --virtual-time-budget=10000 --dump-dom"
)
"""Of chromium; it wants a --user-data-dir of its own besides."""

MEASURE = """<script>
addEventListener("load", () => {
  const shown = [...document.querySelectorAll("body *")].filter(
    each => [...each.childNodes].some(node => node.nodeType == 3 && node.data.trim()));
  const cells = [...document.querySelectorAll("th, td")].map(each => {
    const range = document.createRange();
    range.selectNodeContents(each);
    return {text: range.getBoundingClientRect(), row: each.parentNode.rowIndex};
  });
  const gaps = cells.slice(1).map((each, i) => each.row == cells[i].row
    ? each.text.left - cells[i].text.right : 99);
  const pictures = [...document.images];
  const small = pictures.map(each => each.clientWidth);
  const page = document.documentElement.scrollWidth;
  document.querySelectorAll("input").forEach(each => each.click());
  const large = pictures.map(each => each.clientWidth);
  const element = document.createElement("pre");
  element.id = "measured";
  element.textContent = JSON.stringify({
    width: innerWidth,
    page: Math.max(page, document.documentElement.scrollWidth),
    pictures: pictures.length,
    loaded: pictures.filter(each => each.complete && each.naturalWidth > 500).length,
    fitting: small.filter(each => each <= innerWidth).length,
    full: pictures.filter((each, i) => large[i] == each.naturalWidth).length,
    letters: Math.min(...shown.map(each => parseFloat(getComputedStyle(each).fontSize))),
    gap: Math.min(...gaps),
    requests: performance.getEntriesByType("resource").filter(
      each => !each.name.startsWith("data:")).map(each => each.name),
  });
  document.body.append(element);
});
</script>"""

FRAME = """<!DOCTYPE html>
<iframe src="{name}" width="{width}" height="800" style="border:0"></iframe>
<script>addEventListener("load", () => setTimeout(() =>
  document.body.append(frames[0].document.getElementById("measured")), 200))</script>
"""
"""A window has a least width, a frame in it has not."""


def frames(page: Path) -> list[Path]:
    """Write what a browser is to open beside a page, one a width, and give the paths."""
    measured = page.with_suffix(".measured.html")
    text = page.read_text(encoding="utf-8")
    measured.write_text(text.replace("</head>", f"{MEASURE}</head>"), encoding="utf-8")
    paths = []
    for width in WIDTHS:
        path = page.with_suffix(f".{width}.frame.html")
        path.write_text(FRAME.format(name=measured.name, width=width), encoding="utf-8")
        paths.append(path)
    return paths


def complaints(frame: Path, dom: str) -> list[str]:
    """Find what is wrong with a page, by the DOM of one of its frames."""
    found = re.findall('<pre id="measured">(.*?)</pre>', dom)
    if len(found) != 1:
        return ["nothing has been measured"]
    page = json.loads(html.unescape(found[0]))
    wanted = {
        "it is as wide as the frame": page["width"] == int(frame.name.split(".")[-3]),
        "it does not run out of the window": page["page"] <= page["width"],
        "there are pictures": page["pictures"] > 2,
        "all of them are loaded": page["loaded"] == page["pictures"],
        "they fit": page["fitting"] == page["pictures"],
        "one that is touched has its full size": page["full"] == page["pictures"],
        "letters are legible": page["letters"] >= 12,
        "columns stand apart": page["gap"] >= 8,
        "nothing is asked of the network": page["requests"] == [],
    }
    return [f"not so: {words}; {page}" for words, so in wanted.items() if not so]


def make(folder: Path) -> None:
    """Solve some of the ready problems, and leave their pages and frames."""
    from signorini_cr.app.cli import main

    for name in ("deck", "night", "s1"):
        case = Path(__file__).parents[1] / "meshes" / f"{name}.toml"
        out = folder / name
        words = ["solve", str(case), "--out", str(out), "--levels", "2", "--html", "--quiet"]
        assert main(words) == 0
        frames((out / "report.html").rename(folder / f"{name}.html"))


def judge(folder: Path) -> int:
    """Say what is wrong with the pages; the exit status."""
    paths = sorted(folder.glob("*.frame.html"))
    wrong = 0 if paths else 1
    for path in paths:
        found = complaints(path, Path(f"{path}.dom").read_text(encoding="utf-8"))
        print(f"{path.name}: {'; '.join(found) or 'in order'}")
        wrong += len(found)
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit({"make": make, "judge": judge}[sys.argv[1]](Path(sys.argv[2])))
