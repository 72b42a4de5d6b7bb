"""Validates dataflow files against a JSON Schema, by jsonschema and ruamel.yaml.

    python tests/validate_dataflow.py SCHEMA FILE...

Prints a line of JSON for each file: {"file": ..., "errors": ["PLACE: MESSAGE", ...]}.
"""

import json
import sys
from pathlib import Path

import jsonschema
from ruamel.yaml import YAML

schema = json.loads(Path(sys.argv[1]).read_text())
jsonschema.Draft202012Validator.check_schema(schema)
validator = jsonschema.Draft202012Validator(schema)
for file in sys.argv[2:]:
    # YAML 1.2, as editors read it: `on` is a text.
    document = YAML(typ="safe", pure=True).load(Path(file))
    errors = sorted(validator.iter_errors(document), key=lambda error: list(map(str, error.absolute_path)))
    print(json.dumps({"file": file, "errors": [f"{'/'.join(map(str, e.absolute_path))}: {e.message}" for e in errors]}))
