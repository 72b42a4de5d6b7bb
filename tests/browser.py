#!/usr/bin/env python3
"""A browser for tests/common/browser.rs: headless Chromium, driven by selenium.

Opens URL and prints null. Then it reads lines from stdin: an expression in JavaScript, whose value is printed as a line of JSON;
`axe`, for the list of problems that axe-core finds; `errors`, for what the console said; `picture FILE`, for a screenshot;
`size WIDTH HEIGHT`; `dark`, for a dark theme; `latency MS`, for a slow line from the next request on.

Usage: browser.py URL
"""

import json
import os
import sys
import tempfile

from axe_core_python.selenium import Axe
from selenium import webdriver


def main() -> None:
    options = webdriver.ChromeOptions()
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with tempfile.TemporaryDirectory() as profile:
        # The driver leaves folders of its own behind.
        os.environ["TMPDIR"] = profile
        for word in ("headless=new", "no-sandbox", "use-angle=swiftshader", "enable-unsafe-swiftshader", "disable-quic", "no-first-run",
                     "disable-background-networking", "disable-component-update", "disable-sync", f"user-data-dir={profile}"):
            options.add_argument(f"--{word}")
        driver = webdriver.Chrome(options, webdriver.ChromeService("/usr/bin/chromedriver"))
        try:
            # Drawing in software beside other work takes its time.
            driver.set_script_timeout(300)
            driver.set_page_load_timeout(300)
            driver.set_window_size(1280, 1000)
            driver.get(sys.argv[1])
            print("null", flush=True)
            for line in sys.stdin:
                print(json.dumps(answer(driver, line.strip())), flush=True)
        finally:
            driver.quit()


def answer(driver, line):
    word, _, rest = line.partition(" ")
    if word == "axe":
        return [f"{found['id']}: {found['nodes'][0]['html']}" for found in Axe().run(driver)["violations"]]
    if word == "errors":
        return [entry["message"] for entry in driver.get_log("browser")]
    if word == "picture":
        return driver.get_screenshot_as_file(rest)
    if word == "size":
        return driver.set_window_size(*map(int, rest.split()))
    if word == "dark":
        features = [{"name": "prefers-color-scheme", "value": "dark"}]
        return driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
    if word == "latency":
        conditions = {"offline": False, "latency": float(rest), "downloadThroughput": -1, "uploadThroughput": -1}
        driver.execute_cdp_cmd("Network.enable", {})
        return driver.execute_cdp_cmd("Network.emulateNetworkConditions", conditions)
    return driver.execute_script(f"return {line}")


main()
