"""Recordings, models and graphs of blindgrasp in Python: tactile grasps as numpy arrays, predictions, live decisions.

    import blindgrasp

    for grasp in blindgrasp.Recording("run.mcap"):        # one grasp at a time
        settled = grasp.cells_newtons[grasp.phase == "settled"]

    predictions = blindgrasp.Model("model.json").predict("run.mcap")

    with blindgrasp.run("dataflow.yaml") as graph:        # starts the graph, and ends it
        for decision in graph:
            print(decision.grasp_id, decision.action)

Recordings are read here; all else is done by the program `blindgrasp` (`blindgrasp.program()`). Nothing here computes a
feature or a probability, so that Python and a robot never disagree.
"""

from ._graph import Run, echo, run
from ._model import Model, Predictions
from ._program import ProgramError, ProgramNotFoundError, program
from ._recording import Grasp, Recording, RecordingError, read
from ._types import Decision, Label

__all__ = [
    "Decision",
    "Grasp",
    "Label",
    "Model",
    "Predictions",
    "ProgramError",
    "ProgramNotFoundError",
    "Recording",
    "RecordingError",
    "Run",
    "echo",
    "program",
    "read",
    "run",
]
