"""
How long the page of the λ dial takes to answer: from an input event to the frame that shows its number and its pictures.

    python benchmarks/dial_latency.py                 # needs the extra `lab`, selenium, chromium and chromedriver

Every dial is moved by single presses of an arrow key, each after the answer to the one before, and by drags with a move
every 16 milliseconds. All is measured by the page itself, with the times that the browser gives its events. A move whose value
is never shown, as a later one has overtaken it, is answered by the first that is.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.ui import WebDriverWait

#: (tab, dial, the picture that changes with any change of it)
DIALS = (
    ("robot", "rollout_lambda", "trade-off"),
    ("robot", "rollout_gamma", "response"),
    ("grid", "gae_lambda", "trace"),
    ("grid", "gamma", "trace"),
)
#: steps of the run before the gridworld's dials are turned, so that its curves have something in them
RUN = 40
#: presses in the same direction; no dial has fewer steps
ONE_WAY = 30
PATIENCE = 60

WATCH = """
const [marker, picture] = arguments;
const find = name => document.querySelector(`[data-test="${name}"]`);
const slider = find(marker), thumb = slider.querySelector(".q-slider__thumb");
const number = find(marker + "-shown"), pictures = find(picture);
window.unwatch?.();
const inputs = [], waits = [];
let event = null, answered = 0, pending = null;
const take = each => { event = each; setTimeout(() => { event = null; }); };
for (const kind of ["keydown", "mousedown", "mousemove"]) addEventListener(kind, take, true);
const [low, high] = ["min", "max"].map(end => +slider.getAttribute("aria-value" + end)), step = +slider.dataset.step;
// The thumb moves in the task of the event that moves it; when the answer moves it there again, no event is at hand
const moved = new MutationObserver(() => {
  const part = parseFloat(thumb.style.left) / 100;
  const value = +(low + Math.round(part * (high - low) / step) * step).toFixed(6);
  if (event && (!inputs.length || inputs.at(-1).value !== value)) inputs.push({ time: event.timeStamp, value });
});
moved.observe(thumb, { attributes: true, attributeFilter: ["style"] });
const shown = new MutationObserver(records => {
  if (records.some(each => number.contains(each.target))) {
    const place = inputs.findLastIndex(each => each.value === +number.textContent);
    if (place >= answered) pending = place + 1;
  }
  if (pending === null || !records.some(each => pictures.contains(each.target))) return;
  const times = inputs.slice(answered, pending).map(each => each.time);
  answered = pending;
  pending = null;
  // A message posted in a frame comes when the frame is painted
  const painted = new MessageChannel();
  painted.port1.onmessage = () => { for (const time of times) waits.push(performance.now() - time); };
  requestAnimationFrame(() => painted.port2.postMessage(null));
});
for (const each of [number, pictures]) shown.observe(each, { subtree: true, childList: true, characterData: true });
window.unwatch = () => {
  moved.disconnect(); shown.disconnect();
  for (const kind of ["keydown", "mousedown", "mousemove"]) removeEventListener(kind, take, true);
};
window.latency = () => ({ inputs: inputs.length, waits });
"""


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--moves", type=int, default=120, help="of each dial by each of keyboard and drag (%(default)s)")
    n_moves = parser.parse_args(arguments).moves
    print(f"load of the machine before: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    with served() as address, chromium() as browser:
        browser.get(address)
        until(browser, lambda: browser.find_element(By.CSS_SELECTOR, "[data-test=step-count]").text == "step 0")
        press(browser, "preset-broken_v", "step-count", "step 0")
        for step in range(RUN):
            press(browser, "step", "step-count", f"step {step + 1}")
        for tab, dial, picture in DIALS:
            # The dial before may have scrolled the tabs away
            browser.execute_script("scrollTo(0, 0)")
            browser.find_element(By.CSS_SELECTOR, f"[data-test=tab-{tab}]").click()
            until(browser, lambda dial=dial: track(browser, dial).is_displayed())
            report(f"{dial}, keyboard", by_keyboard(browser, dial, picture, n_moves))
            report(f"{dial}, drag", by_drag(browser, dial, picture, n_moves))
            # With λ = 0 nothing that is sampled would depend on γ
            track(browser, dial).send_keys(Keys.END)
    print(f"load of the machine after: {os.getloadavg()[0]:.1f}")
    return 0


def report(what: str, waits: np.ndarray) -> None:
    """Print the waits of one dial, in milliseconds."""
    median, high = np.percentile(waits, [50, 95])
    late = np.mean(waits > 100.0)
    print(
        f"{what:26}{len(waits):4} moves: median {median:5.1f} ms, 95th percentile {high:5.1f}, longest {waits.max():5.1f}, "
        f"{late:.0%} over 100",
        flush=True,
    )


def by_keyboard(browser: webdriver.Chrome, dial: str, picture: str, n_moves: int) -> np.ndarray:
    """Waits of presses of the arrow keys, up from the low end and down again, and so on."""
    element = watched(browser, dial, picture)
    for move in range(n_moves):
        element.send_keys(Keys.LEFT if move // ONE_WAY % 2 else Keys.RIGHT)
        until(browser, lambda move=move: answers(browser) > move)
    return waits(browser)


def by_drag(browser: webdriver.Chrome, dial: str, picture: str, n_moves: int) -> np.ndarray:
    """Waits of the moves of two drags, one up and one down. In neither does a value come twice: an answer is known by it."""
    places = np.linspace(0.02, 0.98, (n_moves + 1) // 2)
    return np.concatenate([one_drag(browser, dial, picture, each) for each in (places, places[::-1])])


def one_drag(browser: webdriver.Chrome, dial: str, picture: str, places: np.ndarray) -> np.ndarray:
    """Waits of the moves of a drag through places that are parts of the dial's width."""
    element = watched(browser, dial, picture)
    script = "const b = arguments[0].getBoundingClientRect(); return [b.x, b.y + b.height / 2, b.width]"
    box = browser.execute_script(script, element)

    def mouse(kind: str, place: float) -> None:
        event = {"type": kind, "x": box[0] + box[2] * place, "y": box[1], "button": "left", "buttons": 1, "clickCount": 1}
        browser.execute_cdp_cmd("Input.dispatchMouseEvent", event)

    mouse("mousePressed", places[0])
    for place in places:
        start = time.monotonic()
        mouse("mouseMoved", place)
        time.sleep(max(0.0, 0.016 - (time.monotonic() - start)))
    mouse("mouseReleased", places[-1])
    until(browser, lambda: answers(browser) == browser.execute_script("return latency().inputs"))
    return waits(browser)


def watched(browser: webdriver.Chrome, dial: str, picture: str) -> WebElement:
    """What takes the input of a dial, which is at its low end and measured from now on."""
    element = track(browser, dial)
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", element)
    element.send_keys(Keys.HOME)
    time.sleep(1.0)
    browser.execute_script(WATCH, dial, picture)
    return element


def track(browser: webdriver.Chrome, dial: str) -> WebElement:
    return browser.find_element(By.CSS_SELECTOR, f"[data-test={dial}] .q-slider__track-container")


def answers(browser: webdriver.Chrome) -> int:
    return len(waits(browser))


def waits(browser: webdriver.Chrome) -> np.ndarray:
    return np.array(browser.execute_script("return latency().waits"))


def press(browser: webdriver.Chrome, marker: str, shown: str, text: str) -> None:
    browser.execute_script(f"document.querySelector('[data-test={marker}]').click()")
    until(browser, lambda: browser.find_element(By.CSS_SELECTOR, f"[data-test={shown}]").text == text)


def until(browser: webdriver.Chrome, condition: object) -> None:
    WebDriverWait(browser, PATIENCE, poll_frequency=0.02, ignored_exceptions=[Exception]).until(lambda _: condition())


@contextmanager
def served() -> Iterator[str]:
    """Address of a server of the page."""
    command = [sys.executable, "-m", "sb3_gae.gridworld", "--port", "0", "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parent.parent) as server:
        try:
            found = re.search(r"http://\S+/", server.stdout.readline())
            if found is None:
                raise RuntimeError("The page is not served; see above.")
            yield found[0]
        finally:
            server.terminate()


@contextmanager
def chromium() -> Iterator[webdriver.Chrome]:
    """Debian's, without a window and at the size of a desktop."""
    binary, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if binary is None or driver is None:
        raise SystemExit("chromium and chromedriver are needed: apt install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1400,1000"):
        options.add_argument(argument)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))
    try:
        yield browser
    finally:
        browser.quit()


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
