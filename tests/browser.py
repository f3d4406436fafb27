"""Selenium and Debian's chromium; whoever imports this is skipped, with the reason, where one of them is not there."""

import shutil

import pytest

pytest.importorskip("nicegui", reason="NiceGUI is needed: pip install -e '.[lab]'")
pytest.importorskip("selenium", reason="Selenium is needed: pip install -e '.[tests]'")
CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
if CHROMIUM is None or DRIVER is None:
    pytest.skip("chromium and chromedriver are needed: apt install chromium chromium-driver", allow_module_level=True)

from selenium import webdriver  # noqa: E402
from selenium.common.exceptions import (  # noqa: E402
    ElementClickInterceptedException,
    StaleElementReferenceException,
)
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.remote.webelement import WebElement  # noqa: E402
from selenium.webdriver.support.ui import WebDriverWait  # noqa: E402

__all__ = [
    "CHROMIUM",
    "DRIVER",
    "By",
    "ElementClickInterceptedException",
    "Keys",
    "StaleElementReferenceException",
    "WebDriverWait",
    "WebElement",
    "webdriver",
]
