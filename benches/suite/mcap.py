"""Writing and reading recordings beside the mcap crate alone, on the same messages with the same compression.

Ours makes messages of samples and samples of messages, and checks all it reads; mcap's writer and reader are given bytes
and give bytes. The sides take turns. Both wait until the files are on the disk.
"""

import json

from . import figures, programs
from .options import Option

OPTIONS = {
    "samples": Option(100_000, "samples to write and read", quick=2000, least=1),
    "repeats": Option(9, "how often each side writes and reads", quick=2, least=1),
    "folder": Option(programs.PROJECT / "target", "where the files are written"),
}
EXAMPLES = ("mcap_throughput",)
SIZES = {"write": "n_message_bytes", "live": "n_live_message_bytes", "read": "n_message_bytes"}


def measure(options):
    command = [programs.EXAMPLES / "mcap_throughput", programs.HELD_OUT, options.folder, options.samples, options.repeats]
    return json.loads(programs.output(*command))


def show(result):
    rows = []
    for what, ratio in result["ratio"].items():
        n_bytes = result[SIZES[what]]
        speeds = [n_bytes / result["median_secs"][side] / 1e6 for side in (what, f"{what}_mcap")]
        rows.append([what, *(f"{speed:.0f} MB/s" for speed in speeds), f"{ratio:.2f}"])
    figures.table(["", "ours", "mcap", "ratio"], rows)
