"""The report: complete for a full record, and whole even where parts are missing or broken."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest

from magic_bringup import report
from magic_bringup.record import Record, empty_summary, take, write_summary
from magic_core import conversions
from magic_core import strategy as strategies
from magic_core.errors import Code, MagicError
from magic_interfaces.action import RunStrategy
from magic_interfaces.msg import CandidateReport
from magic_server.testing import fakes

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("strategies") / "fake"
    strategies.save(fakes.strategy(), path)
    return path


def full(folder, tmp_path, variant="arm"):
    record = Record(empty_summary(str(folder), variant, command="bash ros2_ws/demo.sh --out 'a <folder>'"))
    result = RunStrategy.Result(code=0, verified=True, tool_id="object_1", target_id="object_2", message="passed")
    result.rollouts, result.success_rate, result.rate_low, result.rate_high = 9, 1.0, 0.71, 1.0
    result.failures, result.notes = ["1 x DRIFT"], ["the arm <i>stands</i> at home"]
    result.plan = conversions.plan_to_msg(fakes.plan(variant), "object_1")
    result.candidates = [
        CandidateReport(
            candidate=conversions.candidate_to_msg(fakes.candidate()),
            reflection="keep",
            stage="verify",
            code=int(code),
            message="why <b>so</b>" + ", and at what length a verdict of the engine says so" * 6,
            rollouts=9,
        )
        for code in (Code.DRIFT, Code.OK)
    ]
    result.heatmap = conversions.image_to_msg(np.random.default_rng(0).random((64, 64)).astype(np.float32), "32FC1")
    result.film = conversions.image_to_msg(np.zeros((40, 80, 3), np.uint8), "rgb8")
    record.result = result
    record.scene = conversions.scene_to_msg(fakes.scene())
    color = np.full((48, 64, 3), 90, np.uint8)
    depth = np.full((48, 64), 700, np.uint16)
    depth[:8] = 0
    record.images = {
        "/camera/left/color/image_raw": conversions.image_to_msg(color, "rgb8"),
        "/camera/left/aligned_depth_to_color/image_raw": conversions.image_to_msg(depth, "16UC1"),
    }
    take(record.summary, result)
    record.summary["peak_memory_mb"] = {"perception": 470.0}
    return record


@pytest.mark.parametrize("variant", ["arm", "fg"])
def test_a_full_report_is_self_contained(folder, tmp_path, variant):
    page = report.render(full(folder, tmp_path, variant))
    assert "could not be drawn" not in page
    for title in (
        "What the cameras saw",
        "From the demonstrated contact",
        "What was reconstructed",
        "Simulation",
        "Candidates",
        "Time and memory",
    ):
        assert title in page
    assert ("Joints" if variant == "arm" else "Motion of the tool") in page
    # Nothing is fetched from elsewhere, and what nodes say is not taken for markup.
    assert not re.search(r"""(src|href)=["'](?!data:)""", page)
    assert "<b>so</b>" not in page
    assert "<i>stands" not in page and "<folder>" not in page
    assert page.count("data:image/") >= 9


class Page(HTMLParser):
    """The elements of a page; raises where tags do not close in order."""

    VOID = ("meta", "img", "br")

    def __init__(self, text):
        super().__init__()
        self.open, self.found, self.style, self.text = [], [], "", []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        (self.text.append(data) if self.open[-1:] != ["style"] else setattr(self, "style", self.style + data))


def test_nothing_on_the_page_asks_for_more_than_a_phone_is_wide(folder, tmp_path):
    """At 390 px less the margins: no width or column of a fixed size beyond that, tables whose rows
    become cards, boxes that break or scroll."""
    page = Page(report.render(full(folder, tmp_path), tmp_path))
    assert ("meta", {"name": "viewport", "content": "width=device-width,initial-scale=1"}) in page.found
    room = 390 - 2 * 8 - 2 * 12 - 2
    screen, phone = page.style.split("@media (max-width:640px)")
    for pixels in re.findall(r"(?<!max-)(?<!-)(?:min-width|width|flex-basis):(\d+)px", page.style):
        assert int(pixels) <= room
    for columns in re.findall(r"grid-template-columns:([^;}]+)", page.style):
        assert "100%" in columns or "minmax(0,1fr)" in columns, columns
    assert "img{width:100%" in screen and "overflow-wrap:anywhere" in screen and "pre{" in screen and "overflow:auto" in screen
    assert "table.cells td::before{content:attr(data-label)" in phone
    for tag, attributes in page.found:
        assert not re.search(r"width:\s*\d+px", attributes.get("style", "") or "") and "width" not in attributes, tag
    # Of tables that stay tables on a phone none has more than two columns, of those that become cards every cell says what it is.
    for table in re.findall(r"<table>.*?</table>", report.render(full(folder, tmp_path)), re.DOTALL):
        assert max(row.count("<td") + row.count("<th") for row in table.split("</tr>")) <= 2
    (cells,) = re.findall(r'<table class="cells">.*?</table>', report.render(full(folder, tmp_path)), re.DOTALL)
    assert cells.count("<td") == cells.count("data-label") == 2 * 9


#: A page that shows another one in a frame so many pixels wide, and says how wide that became and what of it lies outside, unless in a
#: box that is scrolled.
FRAME = """<!doctype html><body style="margin:0"><iframe id=f style="width:WIDTHpx;height:844px;border:0" src="report.html"></iframe>
<pre id=o></pre><script>f.onload=()=>{const d=f.contentDocument,out=[];let boxes=0;
for(const e of d.querySelectorAll('body *')){const r=e.getBoundingClientRect();let inside=false;
for(let a=e.parentElement;a&&a!==d.body;a=a.parentElement)inside=inside||f.contentWindow.getComputedStyle(a).overflowX!=='visible';
if(inside){boxes++;continue}
if(r.right>d.documentElement.clientWidth+0.5||r.left<-0.5)out.push(e.tagName+'.'+e.className)}
o.textContent='measured '+JSON.stringify([d.documentElement.scrollWidth,d.documentElement.clientWidth,out,boxes,d.querySelectorAll('img').length,
[...d.querySelectorAll('th')].filter(e=>e.getBoundingClientRect().height>40).map(e=>e.textContent),
[...d.querySelectorAll('img')].filter(i=>!i.naturalWidth).length])}</script></body>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium (Debian's package) to look at the page with")
@pytest.mark.parametrize("width", [390, 1280])
def test_a_browser_shows_the_page_no_wider_than_its_window(folder, tmp_path, width):
    (tmp_path / "report.html").write_text(report.render(full(folder, tmp_path)))
    (tmp_path / "frame.html").write_text(FRAME.replace("WIDTH", str(width)))
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files", "--virtual-time-budget=10000", "--dump-dom")
    where = (f"--user-data-dir={tmp_path / 'profile'}", f"file://{tmp_path / 'frame.html'}")
    shown = subprocess.run([CHROMIUM, *options, *where], capture_output=True, text=True, timeout=120, check=True).stdout
    page_width, window, outside, scrolled, images, broken_heads, broken = json.loads(re.search(r"measured (\[.*\])<", shown)[1])
    assert width - 20 <= window <= width and page_width <= window and outside == []
    assert images >= 9 and broken == 0 and broken_heads == [] and scrolled > 0


def test_the_page_says_when_by_what_and_what_its_words_mean(folder, tmp_path):
    record = full(folder, tmp_path)
    text = " ".join(Page(report.render(record)).text)
    for words in (record.summary["date"].replace("T", " "), record.summary["version"], "bash ros2_ws/demo.sh --out 'a <folder>'"):
        assert words in text
    assert "100 % of 9 rollouts, 95 % interval 71 to 100 %" in text and "1 x DRIFT" in text
    for term, meaning in report.TERMS:
        assert term in text and meaning in text
    # What stands in the heads of tables is explained.
    heads = set(re.findall(r"<th>([^<#]+)</th>", report.render(record))) - {"tool", "what became of it", "process", "wall time"}
    explained = {word for term, _ in report.TERMS for word in re.split(r", ", term)}
    assert heads <= explained, heads - explained


def test_an_older_summary_is_drawn_as_well(folder, tmp_path):
    record = full(folder, tmp_path)
    for later in ("rollouts", "rate_interval", "date", "version", "command", "failures", "notes", "executed"):
        del record.summary[later]
    assert "could not be drawn" not in report.render(record)


def test_a_run_that_never_began_has_a_report_too(tmp_path):
    record = Record(empty_summary("hooking", "arm"))
    record.summary.update(code=int(Code.BAD_BAG), message="the bag is empty")
    page = report.render(record)
    assert "111 BAD_BAG" in page
    assert "the bag is empty" in page


def test_names_of_files_need_not_be_utf8(tmp_path):
    record = Record(empty_summary("hooking", "arm"))
    record.summary.update(code=int(Code.BAD_BAG), message="no such bag: bag\udcff")
    report.write(record, tmp_path / "report.html")
    assert "no such bag: bag?" in (tmp_path / "report.html").read_text()


def test_broken_parts_leave_the_others_alone(folder, tmp_path):
    record = full(folder, tmp_path)
    record.images["/camera/left/color/image_raw"].encoding = "bayer_rggb8"
    record.result.film.step = 1
    page = report.render(record)
    assert "bayer_rggb8" in page
    assert "could not be drawn" in page
    assert "What was reconstructed" in page


def test_a_record_comes_back_from_disk(folder, tmp_path):
    record = full(folder, tmp_path)
    write_summary(record, tmp_path)
    report.save(record, tmp_path)
    again = report.load(tmp_path)
    assert report.render(again) == report.render(record)
    with pytest.raises(MagicError):
        report.load(tmp_path / "nothing")


def test_the_circle_of_curvature_lies_on_the_right_side(folder):
    strategy = strategies.load(folder)
    view, contact = strategy.tool_view, strategy.tool_contact
    picture = report.contact_picture(view, contact)
    # Convex with r = 20 mm at 0.1 m over 64 pixels: the circle's far end lies 40 mm inwards (left) of the contact.
    scale = report.PICTURE / 64
    radius = 0.02 / view.metres_per_pixel * scale
    u, v = ((contact.pixel + 0.5) * scale - 0.5).round().astype(int)
    near = picture[v - 3 : v + 4, round(u - 2 * radius) - 3 : round(u - 2 * radius) + 4].reshape(-1, 3)
    assert np.abs(near.astype(int) - report.CIRCLE).sum(axis=1).min() < 60


def test_depth_without_any_value_is_black():
    assert not report.depth_picture(np.full((4, 5), np.nan, np.float32)).any()
