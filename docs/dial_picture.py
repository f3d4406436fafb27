"""
Draws docs/images/dial.png: the page of the λ dial while a preset learns. Needs chromium and its driver, and Selenium.

    python docs/dial_picture.py
"""

import shutil
import subprocess
import sys
import time
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

PICTURE = Path(__file__).parent / "images" / "dial.png"
PRESET, SECONDS, SIZE = "sweet_spot", 12.0, (1300, 1230)


def main() -> None:
    command = [sys.executable, "-m", "sb3_gae.gridworld", "--port", "0", "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        address = server.stdout.readline().split()[5].rstrip(";")
        try:
            take(address)
        finally:
            server.terminate()
    print(f"wrote {PICTURE}")


def take(address: str) -> None:
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", f"--window-size={SIZE[0]},{SIZE[1]}"):
        options.add_argument(argument)
    page = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    page.get(address)
    for marker in (f"preset-{PRESET}", "play"):
        find = f"[data-test={marker}]"
        WebDriverWait(page, 60).until(lambda page, find=find: page.find_elements(By.CSS_SELECTOR, find))
        page.execute_script("arguments[0].click()", page.find_element(By.CSS_SELECTOR, find))
        time.sleep(1.0)
    time.sleep(SECONDS)
    page.execute_script("window.scrollTo(0, 0)")
    page.save_screenshot(str(PICTURE))
    page.quit()


if __name__ == "__main__":
    main()
