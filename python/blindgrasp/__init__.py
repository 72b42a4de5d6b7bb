"""Recordings, models and graphs of blindgrasp in Python: tactile grasps as numpy arrays, predictions, live decisions.

    import blindgrasp

    for grasp in blindgrasp.Recording("run.mcap"):        # one grasp at a time
        settled = grasp.cells_newtons[grasp.phase == "settled"]

    table = blindgrasp.Recording("run.mcap").to_frame()   # pandas, a row for each grasp

    blindgrasp.from_table(table, "again.mcap", hand="barrett-bh8-280")    # a table of readings as a recording

    blindgrasp.to_parquet("recordings/", "frames.parquet")  # and to_lerobot: all frames, for other tools

    blindgrasp.from_parquet("frames.parquet", "again/")     # and a dataset of to_lerobot: the same recordings

    predictions = blindgrasp.Model("model.json").predict("run.mcap")

    with blindgrasp.run("dataflow.yaml") as graph:        # starts the graph, and ends it
        for decision in graph:
            print(decision.grasp_id, decision.action)

    decisions = blindgrasp.replay("run.mcap", "dataflow.yaml")     # the same in a test: the fixture `replay` of pytest

    cells = blindgrasp.skin(model, "hand.yaml").read(data)    # the hand's cells in your own MuJoCo model

Recordings and contacts of MuJoCo are read here; all else is done by the program `blindgrasp` (`blindgrasp.program()`).
Nothing here computes a feature or a probability, so that Python and a robot never disagree.
"""

from ._graph import ReplayedDecisions, Run, echo, replay, run
from ._import import from_table
from ._model import Model, PredictedGrasp, Predictions
from ._out import from_parquet, to_lerobot, to_parquet
from ._program import ProgramError, ProgramNotFoundError, program
from ._recording import Grasp, Recording, RecordingError, read
from ._skin import Skin, SkinOptions, skin
from ._types import Decision, Label

# The version of the program and of all else: Cargo.toml has it as well, and a test compares them.
__version__ = "0.1.0"

__all__ = [
    "Decision",
    "Grasp",
    "Label",
    "Model",
    "PredictedGrasp",
    "Predictions",
    "ProgramError",
    "ProgramNotFoundError",
    "Recording",
    "RecordingError",
    "ReplayedDecisions",
    "Run",
    "Skin",
    "SkinOptions",
    "__version__",
    "echo",
    "from_parquet",
    "from_table",
    "program",
    "read",
    "replay",
    "run",
    "skin",
    "to_lerobot",
    "to_parquet",
]
