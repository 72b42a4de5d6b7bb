"""Puts the program into the wheel if BLINDGRASP_WHEEL_PROGRAM names it: `scripts/python-wheel --with-program` sets it."""

import os

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ProgramInWheel(BuildHookInterface):
    """Adds the program, the command that starts it, and the platform that it needs."""

    def initialize(self, version, build_data):
        program = os.environ.get("BLINDGRASP_WHEEL_PROGRAM")
        if not program or version == "editable":
            return
        command = os.path.join(self.root, "command", "blindgrasp")
        build_data["force_include"][program] = "blindgrasp/bin/blindgrasp"
        build_data["shared_scripts"][command] = "blindgrasp"
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{os.environ['BLINDGRASP_WHEEL_PLATFORM']}"
