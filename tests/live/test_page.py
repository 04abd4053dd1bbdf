"""The live page in a real browser and over plain HTTP: data, faults, model changes, hostile text, viewers, tokens."""

import contextlib
import json
import re
import shutil
import signal
import socket
import threading
import time
import urllib.error
import urllib.request
from dataclasses import replace

import pytest

from neurove_core.config import CanonicalConfig, ModelConfig, NetworkConfig
from neurove_core.models import bundle
from neurove_protocol import Twist
from neurove_protocol.control import STATUS_SCHEMA
from neurove_protocol.velocity import SCHEMA
from neurove_service.clients import ask
from neurove_service.config import ClientConfig
from neurove_service.page.images import HEAD
from tests.live.conftest import START_S, Heard, Process, client, free_endpoint, is_alive, running, service, wait_until
from tests.service.page.test_deployment import estimate, status

pytestmark = pytest.mark.live

CHROMIUM = shutil.which("chromium")
ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--disable-component-update",
    "--no-first-run",
)
HOSTILE = "<script>document.title='taken'</script><img src=x onerror=\"document.title='taken'\">"
SMALL = ModelConfig(
    canonical=CanonicalConfig(width=24, height=16),
    network=NetworkConfig(channels=(4, 4), features=8, hidden=8),
    settle_windows=4,
    low_activity_events=10,
)


class Page:
    """A `neurove page` process and what it printed."""

    def __init__(self, process):
        self._out = process.child.stdout
        self.url = re.search(r"(http://\S+/)", self.line("page: "))[1]

    def line(self, begin):
        """The next line that begins so."""
        for line in self._out:
            if line.startswith(begin):
                return line.strip()
        pytest.fail(f"the page ended before it printed {begin!r}")

    def request(self, path, body=None, **headers):
        """Status, headers and text of a request; a POST comes from the page's own origin unless told otherwise."""
        headers = {"Origin": self.url.rstrip("/")} | headers if body is not None else headers
        data = None if body is None else json.dumps(body).encode()
        sent = {name: value for name, value in headers.items() if value is not None}
        request = urllib.request.Request(self.url.rstrip("/") + path, data, sent)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return answer.status, answer.headers, answer.read().decode(errors="replace")
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.headers, error.read().decode()

    def sends_images(self):
        """Whether the images of cam0 are sent."""
        try:
            with urllib.request.urlopen(self.url + "images?s=cam0", timeout=60) as answer:
                _, place, size = HEAD.unpack(answer.read(HEAD.size))
                return place == 0 and len(answer.read(size)) == size
        except urllib.error.HTTPError:
            return False

    def state(self):
        """The first message that a new viewer gets."""
        with urllib.request.urlopen(self.url + "feed", timeout=60) as answer:
            for line in answer:
                if line.startswith(b"data: "):
                    return json.loads(line.removeprefix(b"data: "))
        return pytest.fail("no message")


@pytest.fixture(scope="module")
def models_dir(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    for seed, name in ((1, "one"), (2, "two")):
        bundle.save(replace(bundle.untrained(seed, SMALL, name), trained=True), folder / f"{name}.safetensors")
    return folder


@contextlib.contextmanager
def opened(endpoint, *arguments):
    with running("page", "--connect", endpoint, "--listen", "0", *arguments) as process:
        yield Page(process), process


@pytest.fixture(scope="module")
def node(models_dir):
    """A node with a stream, and its page."""
    endpoint = free_endpoint()
    serving = ("--models-dir", str(models_dir), "--model", "one")
    with (
        service(endpoint, *serving) as (_, transport, config),
        running("drive", "pattern://", "--connect", endpoint, "--wait", "120"),
        opened(endpoint, "--operator") as (page, _),
    ):
        yield page, transport, config


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("chromium is not installed")
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS), timeout=120_000)
        yield started
        started.close()


@pytest.fixture
def tab(browser):
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    context.set_default_timeout(120_000)
    one = context.new_page()
    one.faults = []
    one.on("pageerror", lambda error: one.faults.append(str(error)))
    one.on("console", lambda line: one.faults.append(line.text) if "Content Security" in line.text else None)
    yield one
    assert one.faults == []
    context.close()


def text_of(tab, selector):
    return tab.evaluate("selector => document.querySelector(selector)?.innerText ?? ''", selector)


def until(tab, condition, timeout_s=120.0):
    """Wait while the page lives: its events are handled only while playwright runs."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, tab.evaluate("document.body.innerText")[:2000]
        tab.wait_for_timeout(50)


def test_live_numbers_an_image_and_the_model_arrive(node, tab):
    page, *_ = node
    tab.goto(page.url)
    until(tab, lambda: re.search(r"\d", text_of(tab, "#stream-cam0 .linear .value")))
    until(tab, lambda: tab.evaluate("document.querySelector('.picture')?.dataset.images > 2"))
    until(tab, lambda: tab.evaluate("document.querySelectorAll('.chart canvas').length") == 6)
    assert "one" in text_of(tab, ".node .facts")
    assert text_of(tab, "#live") == "live"
    assert re.search(r"lost\s+\S", text_of(tab, "#stream-cam0 .facts"))  # "nothing", or causes on a slow machine
    first = text_of(tab, "#stream-cam0 .plots")
    until(tab, lambda: text_of(tab, "#stream-cam0 .plots") != first)


def test_a_model_change_is_in_the_history_with_its_reason(node, tab):
    page, transport, config = node
    tab.goto(page.url)
    until(tab, lambda: "page started" in text_of(tab, ".history"))
    ask.activate(transport, config, "two", "n1", force="a test of the page")
    until(tab, lambda: text_of(tab, ".history li b") == "two")
    assert len(text_of(tab, ".history li span")) > 5
    until(tab, lambda: "two" in text_of(tab, ".node .facts"))


def test_an_operator_changes_a_model_with_a_token_that_works_once(node, tab):
    page, transport, config = node
    active = ask.models(transport, config)[0].active.name
    other = {"one": "two", "two": "one"}[active]
    token = page.line("operator: ").split("token=")[1].split()[0]
    tab.goto(page.url)
    tab.click("#operate")
    tab.fill("#token", "wrong")
    tab.click("#token-ok")
    until(tab, lambda: "wrong" in text_of(tab, "#token-error"))
    tab.fill("#token", token)
    tab.click("#token-ok")
    until(tab, lambda: tab.evaluate("!!document.querySelector('.operator:not([hidden]) option')"))
    option = tab.evaluate(
        "name => [...document.querySelectorAll('.operator option')].find(o => o.text.startsWith(name)).value", other
    )
    tab.select_option(".operator select", option)
    tab.click(".operator button:not([disabled])")
    tab.click("#confirm-ok")
    until(tab, lambda: re.search("is active|Refused", text_of(tab, ".operator .result")))
    said = text_of(tab, ".operator .result")  # random weights may differ too much: the node's refusal is shown
    now = ask.models(transport, config)[0].active.name
    assert now == (other if "is active" in said else active)
    assert page.request("/session", {"token": token})[0] == 403


def focused(tab):
    """What has the focus, and whether a person sees that it has it."""
    return tab.evaluate(
        """() => {
          const one = document.activeElement, style = getComputedStyle(one), box = one.getBoundingClientRect();
          const name = ["id", "href", "aria-label"].map((name) => one.getAttribute(name)).find((name) => name);
          const ring = style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 2;
          const inside = box.width > 0 && box.left >= 0 && box.top < innerHeight && box.bottom > 0;
          return [name ?? one.textContent, ring && inside];
        }"""
    )


def press(tab, key, times=1):
    """Press a key so many times; what has the focus after each time, which must be visible."""
    passed = []
    for _ in range(times):
        tab.keyboard.press(key)
        name, seen = focused(tab)
        assert seen, (name, passed)
        passed.append(name)
    return passed


def tab_to(tab, name):
    """Press Tab until an element has the focus; return those before it."""
    passed = press(tab, "Tab")
    while passed[-1] != name:
        assert len(passed) < 60, passed
        passed += press(tab, "Tab")
    return passed[:-1]


def shown(tab, page):
    """Open the page, and wait for a stream and a node."""
    tab.goto(page.url)
    until(tab, lambda: re.search(r"\d", text_of(tab, "#stream-cam0 .linear .value")))
    until(tab, lambda: text_of(tab, ".node .facts"))


HISTORY = "Model changes, newest first"


def test_the_tab_key_reaches_each_control_in_the_order_of_the_page(node, tab):
    page, *_ = node
    shown(tab, page)
    assert press(tab, "Tab") == ["#streams"]
    assert "#stream-cam0" in tab_to(tab, "operate")
    assert press(tab, "Tab") == [HISTORY]
    assert press(tab, "Shift+Tab") == ["operate"]


@pytest.mark.parametrize(("link", "then"), [("#streams", HISTORY), ("#stream-cam0", "stream-cam0")])
def test_the_links_of_the_page_work_with_enter(node, tab, link, then):
    page, *_ = node
    shown(tab, page)
    tab_to(tab, link)
    tab.keyboard.press("Enter")
    until(tab, lambda: tab.evaluate("location.hash") == link)
    if link == "#streams":
        tab.keyboard.press("Tab")  # to the next control behind the links
    assert focused(tab) == [then, True]


def test_an_operator_works_with_the_keyboard_alone(node, tab):
    page, transport, config = node
    before = ask.models(transport, config)[0]
    token = page.line("operator: ").split("token=")[1].split()[0]
    shown(tab, page)
    tab_to(tab, "operate")
    assert press(tab, "Enter") == ["token"]
    tab.keyboard.press("Escape")
    until(tab, lambda: focused(tab)[0] == "operate")  # where it was before
    assert press(tab, "Enter") == ["token"]
    tab.keyboard.type("wrong")
    tab.keyboard.press("Enter")
    until(tab, lambda: "wrong" in text_of(tab, "#token-error"))
    assert press(tab, "Tab", 2) == ["token-cancel", "token-ok"]
    assert press(tab, "Shift+Tab", 2) == ["token-cancel", "token"]
    tab.keyboard.press("Control+A")
    tab.keyboard.type(token)
    tab.keyboard.press("Enter")
    until(tab, lambda: tab.evaluate("!!document.querySelector('.operator:not([hidden]) option')"))
    tab_to(tab, "Model to activate")
    tab.keyboard.press("End" if before.available[0].digest == before.active.digest else "Home")
    until(tab, lambda: tab.evaluate("!document.querySelector('.operator button').disabled"))
    assert press(tab, "Tab") == ["Activate"]
    assert press(tab, "Enter") == ["Cancel"]  # the answer that changes nothing comes first
    until(tab, lambda: tab.evaluate("document.querySelector('.operator button').disabled"))  # while it asks
    tab.keyboard.press("Enter")
    until(tab, lambda: focused(tab) == ["Activate", True])
    after = ask.models(transport, config)[0]
    assert (after.epoch, after.active.digest) == (before.epoch, before.active.digest)


def test_a_browser_that_was_too_slow_for_the_images_asks_for_them_anew(node, tab):
    page, *_ = node
    asked = []
    tab.on("request", lambda request: asked.append(request.url) if "/images?" in request.url else None)
    shown(tab, page)
    until(tab, lambda: tab.evaluate("document.querySelector('.picture')?.dataset.images > 2"))
    before = len(asked)
    tab.evaluate("() => { const until = performance.now() + 3000; while (performance.now() < until); }")
    until(tab, lambda: len(asked) > before)
    drawn = int(tab.evaluate("document.querySelector('.picture').dataset.images"))
    until(tab, lambda: int(tab.evaluate("document.querySelector('.picture').dataset.images")) > drawn + 2)


def test_a_request_from_elsewhere_or_without_a_token_changes_nothing(node):
    page, transport, config = node
    before = ask.models(transport, config)[0]
    change = {"node": "n1", "model": "one"}
    for path in ("/operate/activate", "/operate/rollback"):
        assert page.request(path, change)[0] == 403  # no token
        assert page.request(path, change, Cookie="neurove_page=guess")[0] == 403
        assert page.request(path, change, Origin="http://evil.example")[0] == 403
        assert page.request(path, change, Origin=None)[0] == 403
        assert page.request(path)[0] in (404, 405)  # a GET, such as of an image on a foreign page
    assert page.request("/", Host="evil.example")[0] == 403
    after = ask.models(transport, config)[0]
    assert (after.epoch, after.active.digest) == (before.epoch, before.active.digest)
    token = page.line("operator: ").split("token=")[1].split()[0]
    code, headers, _ = page.request("/session", {"token": token})
    cookie = headers["Set-Cookie"]
    assert (code, "HttpOnly" in cookie, "samesite=strict" in cookie.lower()) == (200, True, True)
    key = cookie.partition(";")[0]
    assert page.request("/operate/activate", change, Cookie=key, Origin="http://evil.example")[0] == 403
    assert page.request("/operate/activate", {"node": "../n1"}, Cookie=key)[0] == 400
    code, _, text = page.request("/operate/activate", {"node": "n1", "model": "absent"}, Cookie=key)
    assert (code, "not on this node" in text) == (502, True)


def test_every_answer_forbids_what_the_page_does_not_need(node):
    page, *_ = node
    for path in ("/", "/main.js", "/absent", "/images?s=absent", "/images?s=..%2Fx"):
        code, headers, _ = page.request(path)
        assert code == (404 if "absent" in path or ".." in path else 200)
        policy = headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'")
        assert "unsafe" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"


def test_hostile_names_stay_text(node, tab):
    page, transport, config = node
    keys = config.keys
    transport.put(keys.velocity("bad"), estimate("bad", model=HOSTILE, flags=(HOSTILE,)).encode(), SCHEMA)
    transport.put(keys.status("bad"), status("bad", "lossy", HOSTILE, refusal=HOSTILE).encode(), STATUS_SCHEMA)
    wrong = estimate("named").model_copy(update={"stream": HOSTILE, "twists": (Twist(1, 1, 1, 1, 1, 1),)})
    transport.put(keys.velocity("named"), wrong.encode(), SCHEMA)
    tab.goto(page.url)
    until(tab, lambda: HOSTILE in text_of(tab, "#stream-bad"))
    until(tab, lambda: re.search(r"\d", text_of(tab, "#stream-cam0 .linear .value")))
    assert tab.evaluate("document.querySelectorAll('#streams script, #streams img, #nodes script').length") == 0
    assert "taken" not in tab.title()
    assert HOSTILE not in [one["name"] for one in page.state()["streams"]]


def test_a_viewer_that_never_reads_is_dropped_and_the_others_go_on(node):
    page, *_ = node
    host, port = page.url.removeprefix("http://").rstrip("/").split(":")
    lazy = socket.socket()
    lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    lazy.connect((host, int(port)))
    lazy.sendall(f"GET /feed HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
    with contextlib.ExitStack() as stack:
        stack.callback(lazy.close)
        others = [stack.enter_context(urllib.request.urlopen(page.url + "feed", timeout=60)) for _ in range(3)]
        heard = [0, 0, 0]
        deadline = time.monotonic() + 300
        while not _aborted(lazy):
            assert time.monotonic() < deadline, heard
            for number, other in enumerate(others):
                heard[number] += other.readline().startswith(b"data: ")
        before = list(heard)
        while min(now - then for now, then in zip(heard, before, strict=True)) < 5:
            for number, other in enumerate(others):
                line = other.readline()
                assert line  # the answer goes on
                heard[number] += line.startswith(b"data: ")


def _aborted(lazy):
    """Whether the server has reset a connection that nobody reads from; sending shows it."""
    try:
        lazy.send(b"\r\n")
    except OSError:
        return True
    return False


def test_a_killed_service_is_reported_and_recovers(models_dir, tab):
    endpoint = free_endpoint()
    config = ClientConfig(connect=(endpoint,))
    serving = ("serve", "--listen", endpoint, "--node", "n2", "--models-dir", str(models_dir), "--model", "one")
    first = Process(*serving)
    try:
        with (
            opened(endpoint) as (page, page_process),
            running("drive", "pattern://", "--connect", endpoint, "--wait", "180"),
        ):
            tab.goto(page.url)
            until(tab, lambda: re.search(r"\d", text_of(tab, "#stream-cam0 .linear .value")), START_S)
            first.end(signal.SIGKILL)
            until(tab, lambda: "gone" in text_of(tab, ".node .verdict") or "silent" in text_of(tab, ".node .verdict"))
            until(tab, lambda: text_of(tab, "#stream-cam0 .verdict") == "no service")
            assert text_of(tab, "#banner")
            with running(*serving):
                until(tab, lambda: text_of(tab, ".node .verdict") == "ok", START_S)
                with client(endpoint) as transport:
                    wait_until(lambda: is_alive(transport, config))
                until(tab, lambda: text_of(tab, "#stream-cam0 .verdict") not in ("no service", "stalled"), START_S)
                until(tab, lambda: "started again" in text_of(tab, ".history"))
                page_process.child.send_signal(signal.SIGSTOP)
                try:
                    until(tab, lambda: text_of(tab, "#live") == "connection lost")
                    assert "lost its connection" in text_of(tab, "#banner")
                finally:
                    page_process.child.send_signal(signal.SIGCONT)
                until(tab, lambda: text_of(tab, "#live") == "live")
                until(tab, lambda: not text_of(tab, "#banner"))
    finally:
        first.end(signal.SIGKILL)


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_estimates_go_on_while_a_page_is_stopped_or_killed(node, number):
    _, transport, config = node
    heard = Heard(transport, config)
    with opened(config.connect[0]) as (page, process), urllib.request.urlopen(page.url + "feed", timeout=60):
        process.child.send_signal(number)
        before = heard.of("cam0")[-1:]
        wait_until(lambda: len(heard.of("cam0")) > len(before) + 60)  # three seconds
        process.child.kill()


def test_estimates_go_on_while_a_page_is_flooded_and_it_recovers(node):
    _, transport, config = node
    with opened(config.connect[0]) as (page, _), contextlib.ExitStack() as stack:
        host, port = page.url.removeprefix("http://").rstrip("/").split(":")
        wait_until(page.sends_images)
        done = threading.Event()

        def connected():
            return stack.enter_context(socket.create_connection((host, int(port)), timeout=60))

        def greedy(text):
            """Send requests as fast as the page takes them, and read nothing; begin anew where it closes."""
            while not done.is_set():
                with contextlib.suppress(OSError), socket.create_connection((host, int(port)), timeout=1) as client:
                    while not done.is_set():
                        client.sendall(text)

        for _ in range(300):  # more than the page takes; each has sent half a request
            connected().sendall(b"GET /feed HTTP/1.1\r\n")
        about = f"HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n"
        texts = (f"GET /images?s=cam0 {about}", f"GET /feed {about}", f"GET / {about}", "x" * 1000)
        threads = [threading.Thread(target=greedy, args=(text.encode() * 50,)) for text in texts]
        for thread in threads:
            thread.start()
        try:
            heard = Heard(transport, config)
            wait_until(lambda: len(heard.of("cam0")) >= 60)
        finally:
            done.set()
            for thread in threads:
                thread.join()
        seqs = [one.seq for one in heard.of("cam0")]
        assert seqs == sorted(set(seqs))
        assert is_alive(transport, config)
        stack.close()
        wait_until(page.sends_images)
        assert "cam0" in [one["name"] for one in page.state()["streams"]]


def test_the_demo_opens_a_page_and_ends_it():
    demo = Process("demo", "pattern://", "--seconds", "60", "--page")
    try:
        page = Page(demo)
        assert page.request("/")[0] == 200
    finally:
        demo.end()
    wait_until(lambda: not _answers(page))


def _answers(page):
    try:
        return page.request("/")[0] == 200
    except OSError:
        return False


def test_beyond_loopback_nothing_is_shown_without_the_token():
    with running("page", "--connect", free_endpoint(), "--listen", "0.0.0.0:0") as process:
        line = next(iter(process.child.stdout))
        port, token = re.search(r":(\d+)/#token=(\S+)", line).groups()
        page = Page.__new__(Page)
        page.url = f"http://127.0.0.1:{port}/"
        assert page.request("/")[0] == 200  # the empty page, which asks for the token
        assert page.request("/feed")[0] == page.request("/images?s=cam0")[0] == 401
        assert page.request("/session", {"token": "guess"})[0] == 403
        code, headers, _ = page.request("/session", {"token": token})
        assert code == 200
        key = headers["Set-Cookie"].partition(";")[0]
        assert page.request("/images?s=cam0", Cookie=key)[0] == 404
        assert page.request("/operate/rollback", {"node": "n1"}, Cookie=key)[0] == 403
