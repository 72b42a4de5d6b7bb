"""How hatchling makes the wheel: with the programs if BLINDGRASP_WHEEL_PROGRAM names `blindgrasp`, with the two others beside it.

`scripts/python-wheel --with-program` sets it.
"""

import os
import re

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface


class Publisher(MetadataHookInterface):
    """Has the person who publishes, and the repository, from Cargo.toml."""

    def update(self, metadata):
        with open(os.path.join(self.root, "..", "Cargo.toml"), encoding="utf-8") as file:
            cargo = file.read()
        name, email = re.search(r'^authors = \["(.*) <(.*)>"\]$', cargo, re.MULTILINE).groups()
        metadata["authors"] = [{"name": name, "email": email}]
        metadata["urls"] = {"Repository": re.search(r'^repository = "(.*)"$', cargo, re.MULTILINE)[1]}


class ProgramInWheel(BuildHookInterface):
    """Adds the programs, the command that starts them, and the platform that they need."""

    def initialize(self, version, build_data):
        program = os.environ.get("BLINDGRASP_WHEEL_PROGRAM")
        if not program or version == "editable":
            return
        command = os.path.join(self.root, "command", "blindgrasp")
        for part in ("", "-lab", "-network"):
            build_data["force_include"][program + part] = f"blindgrasp/bin/blindgrasp{part}"
        build_data["shared_scripts"][command] = "blindgrasp"
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{os.environ['BLINDGRASP_WHEEL_PLATFORM']}"
