"""The page in a browser without a window, as its user meets it."""

import base64
import json
import os
import shutil
import signal
import socket
import subprocess
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from palpate.offline.identify import identify
from palpate.online.client.session import Session
from palpate.online.session.recording import read_recording
from palpate.shared.mechanics.footprint import TIP_DEPTH
from palpate.shared.progress import Progress, tell, training_folder

from ..conftest import PALPATE
from .conftest import rewritten

pytestmark = pytest.mark.service

MIDDLE = 480, 330
"""Where the tissue is seen on a page of 1280 x 720."""

OPENED = "window.palpate?.session?.reader && palpate.opened"


def press(tab, x, y):
    tab.mouse("moved", x, y)
    tab.mouse("pressed", x, y, button="left", buttons=1, clickCount=1)


def release(tab, x, y):
    tab.mouse("released", x, y, button="left", clickCount=1)


@pytest.fixture(scope="module")
def tab(new_tab):
    """Return a tab, which draws no more when these tests are over."""
    tab = new_tab()
    yield tab
    tab.open("about:blank")


@pytest.fixture
def page(tab, server):
    """Return a tab in which the quick scene has just been opened."""
    tab.open("about:blank")
    tab.open(server.url)
    tab.wait(OPENED)
    return tab


PIXELS = """(() => {
    const { view } = palpate, { gl, canvas } = view;
    palpate.draw();
    const pixels = new Uint8Array(4 * canvas.width * canvas.height);
    gl.readPixels(0, 0, canvas.width, canvas.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    return new Uint32Array(pixels.buffer);
})()"""
"""Colours of the picture, read before it is shown."""


def test_it_is_up_without_complaints_and_asks_nobody_else(page, server):
    for address in page.requests:
        assert address.startswith((server.url, server.url.replace("http:", "ws:"))), address
    assert page.complaints == []
    assert page.run("document.getElementById('link').textContent") == "connected"
    press(page, *MIDDLE)
    page.wait("palpate.answer?.CONTACT && palpate.tool.now === palpate.tool.level")
    different = page.run(f"new Set({PIXELS}).size")
    release(page, *MIDDLE)
    assert different > 100
    assert not page.run("palpate.view.gl.isContextLost()")
    assert page.run("palpate.view.gl.getError()") == 0


COMPARE = """async (positions) => {
    const base = document.querySelector("script[type=module]").src.replace("main.js", "");
    const { Session } = await import(base + "session.js");
    const { view } = palpate;
    let answered = null;
    const session = new Session(palpate.name, {
        greeting: () => {}, state: () => {}, reply: (reply) => answered(reply),
    });
    while (!session.ready) await new Promise((done) => setTimeout(done, 5));
    const found = [];
    for (const position of positions) {
        const reply = await new Promise((resolve) => {
            answered = resolve;
            session.send(position, ["PARTS", "DISPLACEMENT"]);
        });
        const models = [...reply.parts.models];
        for (const k of models) await palpate.fetchModes(k);
        view.showParts(reply.parts);
        palpate.compare(view.readBack(), reply.displacement);
        found.push([palpate.compared, models.length, reply.CONTACT]);
    }
    session.close();
    return found;
}"""


def test_the_shader_makes_the_servers_displacement(page, atlas, rng):
    """At contacts all over the surface, so that local models come and go."""
    radius = atlas.scene.endoscope.radius
    at = rng.integers(len(atlas.surface.vertices), size=50)
    depth = rng.uniform(0.2, 1.0, 50) * atlas.limits[at, TIP_DEPTH]
    away = (radius - depth)[:, None] * atlas.surface.normals[at]
    positions = (atlas.surface.vertices[at] + away).tolist()
    found = np.array(page.run(f"({COMPARE})({json.dumps(positions)})"), float)
    assert len(found) == 50
    assert found[:, 2].all()
    assert found[:, 0].max() < 1e-3, found[:, 0].max()
    assert found[:, 1].max() > 1


def test_a_drag_feels_what_a_session_feels_at_the_same_positions(page, server):
    x, y = MIDDLE
    press(page, x, y)
    page.wait("palpate.answer?.CONTACT && palpate.tool.now === palpate.tool.level")
    for step in range(1, 11):
        page.mouse("moved", x + 6 * step, y, button="left", buttons=1)
        page.wait(f"palpate.tool.cursor[0] > {2 * (x + 6 * step - 1) / 960 - 1}")
        time.sleep(0.02)
    release(page, x + 60, y)
    page.wait("palpate.tool.now < -0.9 && !palpate.answer.CONTACT")
    log = page.run("palpate.log")
    assert len(log) > 12
    assert sum(np.linalg.norm(entry["force"]) > 0 for entry in log) > 10
    with Session(server.url, "quick") as session:
        for entry in log:
            reply = session.step(entry["asked"])
            np.testing.assert_allclose(entry["force"], reply.force, rtol=1e-9, atol=1e-9)
            np.testing.assert_array_equal(entry["position"], reply.position)


def test_the_wheel_presses_deeper_and_the_lamp_says_what_is_wrong(page):
    x, y = MIDDLE
    press(page, x, y)
    page.wait("palpate.answer?.CONTACT")
    force = page.run("palpate.answer.force")
    for _ in range(40):
        page.mouse("wheel", x, y, deltaX=0, deltaY=-100)
    page.wait("palpate.answer.TOO_DEEP")
    page.wait("document.getElementById('lamp').dataset.state === 'doubt'")
    assert "Out of range: depth" in page.run("document.getElementById('trust').textContent")
    assert np.linalg.norm(page.run("palpate.answer.force")) > np.linalg.norm(force)
    assert "unknown" in page.run("document.getElementById('force').textContent")
    release(page, x, y)


def test_the_lamp_tells_an_error_beside_what_is_allowed_and_moves_nothing(page):
    top = "document.getElementById('level').getBoundingClientRect().top"
    page.wait("document.getElementById('lamp').dataset.state === 'none'")
    before = page.run(top)
    press(page, *MIDDLE)
    page.wait("palpate.answer?.CONTACT && palpate.tool.now === palpate.tool.level")
    page.run("palpate.scene.tolerance.tip_von_mises = 0.001")
    page.wait("document.getElementById('trust').textContent.includes('allowed 0.1 %')")
    words, error = page.run("""[
        document.getElementById("trust").textContent, 100 * palpate.answer.errors.von_mises,
    ]""")
    assert f"stress ± {error:.1f}".rstrip("0").rstrip(".") in words
    assert "larger than this scene allows" in words
    assert page.run(top) == before
    release(page, *MIDDLE)
    page.wait("document.getElementById('lamp').dataset.state === 'none'")


def test_colours_are_those_of_the_tissue_that_is_not_held_and_the_tool_can_be_left_out(page):
    press(page, *MIDDLE)
    page.wait("palpate.answer?.CONTACT && palpate.tool.now === palpate.tool.level && !palpate.pale")
    ordinary, beside = page.run("""(() => {
        const ordinary = palpate.measure("stress").range, own = palpate.stress;
        palpate.stress = Float32Array.from(own);
        palpate.stress[0] = 1e6;  // as at the edge of what is held
        const beside = palpate.measure("stress").range;
        palpate.stress = own;
        return [ordinary, beside];
    })()""")
    assert ordinary <= beside < 10.0 * page.run("palpate.answer.largest_stress")
    apart = page.run(f"""(() => {{
        const seen = {PIXELS};
        document.getElementById("bare").click();
        const bare = {PIXELS};
        document.getElementById("bare").click();
        return seen.reduce((sum, colour, i) => sum + (colour !== bare[i]), 0);
    }})()""")
    assert apart > 1000
    release(page, *MIDDLE)


def test_the_slider_makes_the_tissue_as_stiff(page, server, atlas):
    x, y = MIDDLE
    press(page, x, y)
    page.wait("palpate.answer?.CONTACT && palpate.tool.now === palpate.tool.level")
    page.wait("palpate.session.ready && !palpate.pale")  # nothing is under way
    before = page.run("""(() => {
        const slider = document.getElementById("young"), before = palpate.log.length;
        slider.value = "0.3";
        slider.dispatchEvent(new Event("input"));
        return before;
    })()""")
    page.wait(f"palpate.log.length > {before}")
    log = page.run("palpate.log")
    with Session(server.url, "quick") as session:  # the same from its beginning, to the same bits
        for entry in log[:before]:
            session.step(entry["asked"])
        session.young(atlas.scene.tissue.young * 10**0.3)
        for entry in log[before:]:
            force = session.step(entry["asked"]).force
            np.testing.assert_allclose(entry["force"], force, rtol=1e-9)
    page.wait("location.hash.includes('young=0.3')")
    release(page, x, y)


def test_where_drawing_is_slow_a_picture_that_moves_has_fewer_pixels(page):
    width, whole = "palpate.view.canvas.width", "palpate.view.canvas.clientWidth"
    page.wait(f"{width} === {whole}")
    page.run("for (let i = 0; i < 100; i++) palpate.keepUp(0.1)")
    page.run("window.moving = setInterval(() => { palpate.changed = true; }, 20)")
    page.wait(f"{width} < 0.6 * {whole}")
    page.run("clearInterval(window.moving)")
    page.wait(f"{width} === {whole}")  # it stands still


def test_a_drag_beside_the_tissue_turns_it_and_the_address_says_how(page):
    before = page.run("palpate.camera.yaw")
    page.mouse("pressed", 60, 600, button="left", buttons=1, clickCount=1)
    page.mouse("moved", 160, 600, button="left", buttons=1)
    release(page, 160, 600)
    page.wait(f"palpate.camera.yaw < {before} - 0.1")
    page.wait("decodeURIComponent(location.hash).includes(palpate.camera.toText())")
    view, address = page.run("palpate.camera.toText()"), page.run("location.href")
    page.open("about:blank")
    page.open(address)
    page.wait(OPENED)
    assert page.run("palpate.camera.toText()") == view
    page.wait("palpate.movedAt > 0")  # it is drawn


def test_keys_press_the_middle_where_nothing_is_pointed_at(page):
    page.run("palpate.tool.cursor = [-0.99, -0.99]")
    page.run("document.getElementById('canvas').focus()")
    page.call("Input.dispatchKeyEvent", type="keyDown", key="Enter")
    page.wait("palpate.answer?.CONTACT && palpate.tool.now === palpate.tool.level")
    assert page.run("document.getElementById('lamp').dataset.state") != "bad"
    point = page.run("palpate.tool.place.point")
    np.testing.assert_allclose(point, [5.0, 5.0, 8.0], atol=1.5)
    at = page.run("palpate.camera.project(palpate.tool.place.point)")
    np.testing.assert_allclose(page.run("palpate.tool.cursor"), at)
    page.call("Input.dispatchKeyEvent", type="keyDown", key="Enter")
    page.wait("palpate.tool.now < -0.9")


def test_who_slides_past_the_rim_is_told(page):
    press(page, *MIDDLE)
    page.mouse("moved", 5, 5, button="left", buttons=1)
    page.wait("document.getElementById('trust').textContent.includes('held at the rim')")
    release(page, 5, 5)
    page.wait("!document.getElementById('trust').textContent.includes('held at the rim')")


def test_keys_turn_zoom_and_press(page):
    page.run("document.getElementById('canvas').focus()")

    def key(name):
        page.call("Input.dispatchKeyEvent", type="keyDown", key=name)
        page.call("Input.dispatchKeyEvent", type="keyUp", key=name)

    yaw, distance = page.run("palpate.camera.yaw"), page.run("palpate.camera.distance")
    key("ArrowLeft")
    key("+")
    assert page.run("palpate.camera.yaw") != yaw
    assert page.run("palpate.camera.distance") < distance
    key("Enter")
    page.wait("palpate.answer?.CONTACT")
    key("Enter")
    page.wait("!palpate.answer.CONTACT")


def test_a_hidden_page_sends_nothing(page):
    press(page, *MIDDLE)
    page.wait("palpate.answer?.CONTACT")
    page.run("Object.defineProperty(document, 'hidden', { configurable: true, get: () => true })")
    page.wait("palpate.session.ready")
    sent = page.run("palpate.session.sequence")
    page.mouse("moved", MIDDLE[0] + 20, MIDDLE[1], button="left", buttons=1)
    time.sleep(0.3)
    assert page.run("palpate.session.sequence") == sent
    page.run("delete document.hidden")
    page.wait(f"palpate.session.sequence > {sent}")
    release(page, *MIDDLE)


def test_it_comes_back_when_the_service_does(tab, serve, artifact):
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        port = str(free.getsockname()[1])
    with serve(artifact.parent, "--port", port) as server:
        tab.open(server.url)
        tab.wait(OPENED)
        tab.run("window.same = true")
        server.stop(signal.SIGKILL)
        tab.wait("document.getElementById('message').textContent.includes('Trying again')")
    with serve(artifact.parent, "--port", port):
        tab.wait("palpate.session.reader")
        tab.wait("document.getElementById('link').textContent === 'connected'")
        assert tab.run("document.getElementById('message').hidden")
        press(tab, *MIDDLE)
        tab.wait("palpate.answer?.CONTACT")
        release(tab, *MIDDLE)
        assert tab.run("window.same")


def test_a_scene_that_is_not_served_is_told(tab, server):
    tab.open("about:blank")
    tab.open(f"{server.url}/#scene=nowhere")
    tab.wait("document.getElementById('message')?.textContent.includes('No such scene')")


def test_without_webgl_it_says_what_to_do(new_tab, server):
    tab = new_tab()
    tab.call(
        "Page.addScriptToEvaluateOnNewDocument",
        source="HTMLCanvasElement.prototype.getContext = () => null",
    )
    tab.open(server.url)
    tab.wait("document.getElementById('message')?.textContent.includes('hardware acceleration')")


def test_the_endpoints_are_described_without_another_host(tab, server):
    tab.open(f"{server.url}/docs")
    tab.wait("document.querySelectorAll('details').length > 10")
    text = tab.run("document.body.textContent")
    for words in ("/scenes/{name}/solve", "contacts", "pressure_limit", "Offset", "kPa"):
        assert words.lower() in text.lower(), words
    assert all(address.startswith(server.url) for address in tab.requests)
    assert tab.complaints == []


def test_a_scene_that_is_added_is_offered_and_one_that_goes_is_not(tab, serve, artifact, tmp_path):
    shutil.copy(artifact, tmp_path / "quick.h5")
    offered = "[...document.getElementById('scene').options].map((o) => o.value).join()"
    with serve(tmp_path) as server:
        tab.open(server.url)
        tab.wait(OPENED)
        folder = training_folder(tmp_path / "another.h5")
        folder.mkdir()
        tell(folder, Progress("another", "local models", 3, 10, 0.4, 100.0))
        tab.wait("document.getElementById('training').textContent.includes('40 %, local models')")
        assert "2 min left" in tab.run("document.getElementById('training').textContent")
        rewritten(artifact, tmp_path / "another.h5", 'name = "quick"', 'name = "another"')
        tab.wait(f"{offered} === 'another,quick'")
        assert tab.run("document.getElementById('scene').value") == "quick"
        (tmp_path / "another.h5").unlink()
        tab.wait(f"{offered} === 'quick'")
        press(tab, *MIDDLE)
        tab.wait("palpate.answer?.CONTACT")
        release(tab, *MIDDLE)


SAVED = """(async () => {
    const bytes = new Uint8Array(await (await palpate.recorded.h5()).arrayBuffer());
    return btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));
})()"""

PLAY = """async (text) => {
    await palpate.play(new File([text], "played.csv"));
    return document.getElementById("message").textContent;
}"""


@pytest.fixture
def second(tab, server, serve, artifact):
    """Return a tab with the quick scene of a server that has all its kernels from the cache.

    The first server may have compiled some itself: their last bits are not those of the cache.
    """
    with serve(artifact.parent) as other:
        tab.open(other.url)
        tab.wait(OPENED)
        yield tab
        tab.open("about:blank")


def test_what_is_recorded_is_replayed_played_again_and_tells_the_modulus(
    second, atlas, artifact, tmp_path
):
    page, (x, y) = second, MIDDLE
    page.run("palpate.record()")
    page.wait("palpate.recording.greeting")
    press(page, x, y)
    page.wait("palpate.answer?.CONTACT && palpate.tool.now === palpate.tool.level")
    page.run("palpate.session.command('snapshot', 1)")
    for step in range(1, 9):
        page.mouse("moved", x + 6 * step, y, button="left", buttons=1)
        time.sleep(0.05)
    page.run("palpate.session.command('restore', 1)")
    release(page, x + 48, y)
    page.wait("palpate.tool.now < -0.9 && !palpate.answer.CONTACT")
    page.run("palpate.record()")
    assert page.run("palpate.recording") is None
    assert page.run("document.getElementById('save').hidden") is False
    (tmp_path / "recorded.h5").write_bytes(base64.b64decode(page.run(SAVED)))
    recording = read_recording(tmp_path / "recorded.h5")
    assert [name for _, name, _ in recording.commands] == ["snapshot", "restore"]
    command = [*PALPATE, "replay", str(tmp_path / "recorded.h5"), str(artifact), "--json"]
    replayed = subprocess.run(command, capture_output=True, text=True)
    assert json.loads(replayed.stdout)["different"] == 0
    text = page.run("palpate.recorded.csv().text()")
    (tmp_path / "recorded.csv").write_text(text)
    rows = np.genfromtxt(text.splitlines(), delimiter=",", names=True)
    assert len(rows) == len(recording.replies)
    found = identify(artifact, tmp_path / "recorded.csv")
    assert found["young"] == pytest.approx(atlas.scene.tissue.young, rel=1e-3)
    recorded = {(r["asked_x"], r["asked_y"], r["asked_z"]): r["force_z"] for r in rows}
    page.run("palpate.log.length = 0")
    assert page.run(f"({PLAY})({json.dumps(text)})") == ""
    page.wait("palpate.player === null && !palpate.answer.CONTACT")
    log = [entry for entry in page.run("palpate.log") if tuple(entry["asked"]) in recorded]
    assert len(log) > 5
    most = max(recorded.values())
    for entry in log:
        assert abs(entry["force"][2] - recorded[tuple(entry["asked"])]) < 1e-3 * most
    page.run("document.getElementById('replay').click()")
    page.wait("palpate.player !== null && palpate.answer.CONTACT")
    page.wait("palpate.player === null && !palpate.answer.CONTACT")


SET = PLAY.replace("play(", "set(").replace("played.csv", "task.json")


THERE = """(() => {
    const { answer, log, scene, tool } = palpate, asked = log.at(-1)?.asked;
    return answer?.CONTACT && !answer.CLAMPED && tool.now === tool.level
        && String(asked) === String(tool.centre(scene.ranges.radius));
})()"""


def test_a_task_to_try_lies_on_what_can_be_touched(page, atlas):
    page.run("document.getElementById('example').click()")
    page.wait("document.getElementById('score').textContent.includes('touch its first point')")
    path, limit = page.run("[palpate.task.path, palpate.task.limit]")
    assert len(path) > 2
    away = [atlas.surface.project(np.array(point))[2] for point in path]
    assert max(away) < 0.05
    assert 0.0 < limit < np.inf
    press(page, *MIDDLE)
    page.wait("document.getElementById('where').textContent.split(', ').length === 3")
    release(page, *MIDDLE)


def test_a_task_is_followed_and_scored(page):
    x, y = MIDDLE
    path = []
    for along in (0, 60):
        press(page, x + along, y)
        page.wait(THERE)  # and not on its way
        path.append(page.run("palpate.answer.contact_point"))
        release(page, x + along, y)
        page.wait("palpate.tool.now < -0.9 && !palpate.answer.CONTACT")
    task = {"name": "Across", "path": path, "force_limit": 0.001, "reach": 0.3}
    assert page.run(f"({SET})({json.dumps(json.dumps(task))})") == ""
    page.wait("document.getElementById('score').textContent.includes('touch its first point')")
    page.run("palpate.log.length = 0")
    press(page, x, y)
    page.wait("palpate.task.passed === 1")
    for step in range(1, 11):
        page.mouse("moved", x + 6 * step, y, button="left", buttons=1)
        time.sleep(0.05)
    page.wait("palpate.task.done")
    release(page, x + 60, y)
    score = page.run("({ ...palpate.task })")
    between = np.linalg.norm(np.subtract(*path))
    assert between - 0.6 < score["length"] < 1.3 * between + 1.0
    assert 0.4 < score["time"] < 60.0
    assert score["over"] == pytest.approx(score["time"])  # all of it pressed harder than that
    largest = max(np.linalg.norm(entry["force"]) for entry in page.run("palpate.log"))
    assert 0.0 < score["peak"] <= largest + 1e-9
    page.wait("document.getElementById('score').textContent.startsWith('Across: done')")
    page.run("document.getElementById('again').click()")
    assert page.run("palpate.task.passed") == 0


RECORDINGS = [
    ("time,x,y\n0,1,2\n", "lacks z"),
    ("time,x,y,z\n", "no positions"),
    ("time,x,y,z\n0,1,2,3\n1,1,,3\n", "Line 3"),
    ("time,x,y,z\n1,1,2,3\n0,1,2,3\n", "Line 3"),
    ("time,x,y,z\n0,500,2,3\n1,500,2,3\n", "far from this body"),
    ("\x89HDF\r\n\x1a\n", "palpate replay"),
]
TASKS = [
    ("{", "This is no JSON"),
    ("null", '"path"'),
    ('{"path": [[1, 2, 3]], "force_limit": 1}', '"path" must be 2 to'),
    ('{"path": [[1, 2, 3], [1, 2, null]], "force_limit": 1}', "[x, y, z]"),
    ('{"path": [[1, 2, 3], [1, 2, 4]]}', '"force_limit"'),
    ('{"path": [[1, 2, 3], [1, 2, 4]], "force_limit": 1, "reach": 0}', '"reach"'),
    ('{"path": [[5, 5, 8], [5, 5, 2]], "force_limit": 1}', "Point 2 of the path is 6.0 mm from"),
]


@pytest.mark.parametrize(
    ("give", "name", "kept", "text", "why"),
    [
        *((PLAY, "played.csv", "player", *wrong) for wrong in RECORDINGS),
        *((SET, "task.json", "task", *wrong) for wrong in TASKS),
    ],
)
def test_a_file_that_makes_no_sense_is_told(page, give, name, kept, text, why):
    said = page.run(f"({give})({json.dumps(text)})")
    assert said.startswith(f"{name}: ")
    assert why in said
    assert page.run(f"palpate.{kept}") is None


def test_modes_that_make_no_sense_are_told_and_the_servers_field_is_shown(page):
    page.run("""(() => {
        const real = window.fetch;
        window.fetch = (path, options) => (String(path).includes("/modes/")
            ? Promise.resolve(new Response(new Uint8Array(40))) : real(path, options));
    })()""")
    press(page, *MIDDLE)
    page.wait(
        "document.getElementById('difference').textContent.startsWith('The modes cannot be used')"
    )
    page.wait("palpate.answer?.CONTACT && palpate.tool.now === palpate.tool.level")
    page.wait("Math.max(...palpate.view.readBack()) > 0.01")
    release(page, *MIDDLE)


ENTER = """(() => {
    document.querySelector("#ask input").value = "%s";
    document.querySelector("#ask form").requestSubmit();
})()"""


def test_it_asks_for_the_token_until_it_is_right(new_tab, serve, artifact):
    with serve(artifact.parent, PALPATE_TOKEN="secret") as server:
        tab = new_tab()
        tab.open(server.url)
        tab.wait("document.getElementById('ask')?.open")
        assert tab.run("document.getElementById('wrong').hidden")
        tab.run(ENTER % "guess")
        tab.wait("document.getElementById('ask').open && !document.getElementById('wrong').hidden")
        tab.run(ENTER % "secret")
        tab.wait(OPENED)
        press(tab, *MIDDLE)
        tab.wait("palpate.answer?.CONTACT")
        release(tab, *MIDDLE)
        tab.open("about:blank")


def test_a_picture_of_it(page, tmp_path):
    """The one in README, if its place is said."""
    page.size(1280, 720, "light")
    press(page, *MIDDLE)
    page.wait("palpate.answer?.CONTACT && palpate.tool.now === palpate.tool.level")
    time.sleep(1.0)
    path = Path(os.environ.get("PALPATE_PICTURE", tmp_path / "page.png"))
    path.write_bytes(page.picture())
    release(page, *MIDDLE)
    page.size(1280, 720)
    assert path.stat().st_size > 20_000
