"""Validates dataflow files against a JSON Schema, by jsonschema, as ruamel.yaml and PyYAML read them.

    python tests/validate_dataflow.py SCHEMA FILE...

Prints a line of JSON for each file: {"file": ..., "errors": ["PLACE: MESSAGE", ...]}.
"""

import json
import sys
from pathlib import Path

import jsonschema
import yaml
from ruamel.yaml import YAML

schema = json.loads(Path(sys.argv[1]).read_text())
jsonschema.Draft202012Validator.check_schema(schema)
validator = jsonschema.Draft202012Validator(schema)
for file in sys.argv[2:]:
    # YAML 1.2, as editors read it, in which `on` is a text, and YAML 1.1, in which it is true.
    documents = [YAML(typ="safe", pure=True).load(Path(file)), yaml.safe_load(Path(file).read_text())]
    errors = [error for document in documents for error in validator.iter_errors(document)]
    print(json.dumps({"file": file, "errors": [f"{'/'.join(map(str, e.absolute_path))}: {e.message}" for e in errors]}))
