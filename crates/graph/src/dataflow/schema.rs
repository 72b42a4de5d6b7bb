//! A JSON Schema of the dataflow file, made from the descriptions of the operators: an editor completes and checks with it.
//!
//! It is more lenient than [`check()`](super::check()): it knows the shipped operators only, does not compare the types of
//! ports, and takes `${NAME}` for any value.

use serde_json::{Map, Value, json};

use super::machines_entry::{MAX_BUFFER, MAX_DEADLINE_MILLIS, MIN_DEADLINE_MILLIS};
use super::node::{
    DAY_SECS, HOUR_MILLIS, MAX_CAPACITY, MAX_MEMORY_MIB, MAX_RESTARTS, MIN_HEARTBEAT_MILLIS, MIN_MEMORY_MIB,
    MIN_WINDOW_SECS,
};
use super::process_options::{MAX_CPUS, MAX_POLL_MICROS};
use blindgrasp_operator::description::OperatorDescription;
use blindgrasp_operator::param::{ParamDescription, ParamKind};
use blindgrasp_operator::text::MAX_NAME_CHARS;

/// The schema (draft 2020-12) of a dataflow file with these operators.
#[must_use]
pub fn schema(operators: &[OperatorDescription]) -> Value {
    let name = |operator: &OperatorDescription| operator.operator.clone();
    // The key of a node is its operator unless `run` names another.
    let by_key = operators.iter().map(|operator| {
        let of_key = json!({"if": {"required": ["run"]}, "else": reference(&operator.operator)});
        (name(operator), json!({"description": operator.summary, "allOf": [{"$ref": "#/$defs/NODE"}, of_key]}))
    });
    let by_run = operators.iter().map(|operator| {
        json!({
            "if": {"properties": {"run": {"const": operator.operator}}, "required": ["run"]},
            "then": reference(&operator.operator),
        })
    });
    let mut definitions: Map<_, _> = operators.iter().map(|operator| (name(operator), of_operator(operator))).collect();
    definitions.insert("VARIABLE".into(), json!({"type": "string", "pattern": "[$][{]"}));
    let mut node = node_keys();
    node["run"]["examples"] = operators.iter().map(name).collect();
    let node = json!({
        "type": ["object", "null"],
        "additionalProperties": false,
        "properties": node,
        "allOf": by_run.collect::<Vec<_>>(),
    });
    definitions.insert("NODE".into(), node);
    json!({
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Dataflow file of blindgrasp",
        "type": "object",
        "required": ["version", "name", "operators"],
        "additionalProperties": false,
        "properties": {
            "version": {"const": 1},
            "name": described(name_schema(), "The name of the graph"),
            "params": described(
                shared_params(operators),
                "Params for each node that has a param of the name and does not set it itself",
            ),
            "machines": machines(),
            "link": link(),
            "operators": {
                "type": "object",
                "minProperties": 1,
                "description": "The nodes of the graph by their ids",
                "properties": by_key.collect::<Map<_, _>>(),
                "additionalProperties": {"$ref": "#/$defs/NODE"},
            },
        },
        "$defs": definitions,
    })
}

/// The inputs and params of a node with this operator. Without required params: the file may give them to all nodes.
fn of_operator(operator: &OperatorDescription) -> Value {
    let params = operator.params.iter().map(|param| (param.name.clone(), of_param(param)));
    let inputs = operator.inputs.iter().map(|input| {
        let summary = match input.summary.as_str() {
            "" => input.type_name.clone(),
            summary => format!("{summary} ({})", input.type_name),
        };
        (input.name.clone(), json!({"description": summary}))
    });
    let required: Vec<&String> =
        operator.inputs.iter().filter(|input| !input.optional).map(|input| &input.name).collect();
    let mut of = json!({
        "properties": {
            "params": {"properties": params.collect::<Map<_, _>>(), "additionalProperties": false},
            "inputs": {
                "properties": inputs.collect::<Map<_, _>>(),
                "patternProperties": {"[?]$": {"description": "An input that is left out if the operator has none of the name"}},
                "additionalProperties": false,
                "required": required,
            },
        },
    });
    if !required.is_empty() {
        of["type"] = "object".into();
        of["required"] = json!(["inputs"]);
    }
    of
}

/// A param of this name of any operator. Operators may take different values for it.
fn shared_params(operators: &[OperatorDescription]) -> Value {
    let mut by_name: Map<String, Value> = Map::new();
    for param in operators.iter().flat_map(|operator| &operator.params) {
        let of_param = of_param(param);
        match by_name.get_mut(&param.name) {
            None => {
                by_name.insert(param.name.clone(), json!({"anyOf": [of_param]}));
            }
            Some(known) => {
                if let Some(all) = known["anyOf"].as_array_mut().filter(|all| !all.contains(&of_param)) {
                    all.push(of_param);
                }
            }
        }
    }
    json!({"type": ["object", "null"], "properties": by_name})
}

fn of_param(param: &ParamDescription) -> Value {
    let mut schema = described(of_kind(&param.kind), &param.summary);
    if let Some(default) = &param.default {
        schema["default"] = default.clone();
    }
    schema
}

fn of_kind(kind: &ParamKind) -> Value {
    let of_value = match kind {
        ParamKind::Path { .. } => return json!({"type": "string", "minLength": 1}),
        // A dataflow file needs no quotes for a text: 010 and no are texts, too.
        ParamKind::String {} => return json!({"type": ["string", "number", "boolean"]}),
        ParamKind::Boolean {} => json!({"type": "boolean"}),
        ParamKind::Integer { min, max } => {
            bounded("integer", [("minimum", min.map(Value::from)), ("maximum", max.map(Value::from))])
        }
        ParamKind::Number { above, min, max, words } => {
            let bounds = [("exclusiveMinimum", above), ("minimum", min), ("maximum", max)];
            let number = bounded("number", bounds.map(|(name, bound)| (name, bound.map(Value::from))));
            match words.as_slice() {
                [] => number,
                words => json!({"anyOf": [number, {"enum": words}]}),
            }
        }
        ParamKind::Choice { values } => json!({"enum": values}),
    };
    or_variable(of_value)
}

fn bounded<const N: usize>(of_type: &str, bounds: [(&str, Option<Value>); N]) -> Value {
    let mut schema = json!({"type": of_type});
    for (bound, value) in bounds {
        if let Some(value) = value {
            schema[bound] = value;
        }
    }
    schema
}

fn node_keys() -> Value {
    json!({
        "run": {
            "type": "string",
            "minLength": 1,
            "description": "An operator, a program on PATH, or with a '/' the path of a program; default: the node's id",
        },
        "on": {"type": "string", "description": "The machine that it runs on"},
        "args": {
            "type": ["array", "null"],
            "items": {"type": ["string", "number", "boolean"]},
            "description": "Arguments of the program",
        },
        "inputs": {
            "type": ["object", "null"],
            "description": "Where each input comes from: NODE/PORT",
            "additionalProperties": {"anyOf": [source(), edge()]},
        },
        "params": {"type": ["object", "null"], "description": "The parameters of the operator"},
        "sha256": {
            "type": ["object", "null"],
            "description": "The digests that files may have, by param; 'run' is the program",
            "additionalProperties": {"anyOf": [digest(), {"type": "array", "items": digest()}]},
        },
        // Programs that read YAML 1.1 take the words on and off for truths.
        "sandbox": or_variable(json!({"enum": ["off", "on", "required", true, false]})),
        "memory_max_mib": integer(MIN_MEMORY_MIB, MAX_MEMORY_MIB),
        "restart": {"anyOf": [restart_policy(), {
            "type": "object",
            "additionalProperties": false,
            "properties": {
                "policy": restart_policy(),
                "limit": integer(1, MAX_RESTARTS),
                "within_s": number(MIN_WINDOW_SECS, DAY_SECS),
                "backoff_ms": number(0.0, HOUR_MILLIS),
            },
        }]},
        "heartbeat_ms": {"anyOf": [number(MIN_HEARTBEAT_MILLIS, HOUR_MILLIS), {"enum": ["off", false]}]},
        "group": described(name_schema(), "Nodes of the same group share a process"),
        "wait": {"anyOf": [words(&["event", "poll"]), {
            "type": "object",
            "required": ["poll_us"],
            "additionalProperties": false,
            "properties": {"poll_us": integer(1, MAX_POLL_MICROS)},
        }]},
        "scheduling": {
            "type": "object",
            "required": ["policy", "priority"],
            "additionalProperties": false,
            "properties": {"policy": words(&["fifo", "round_robin"]), "priority": integer(1, 99)},
        },
        "cpus": {"type": "array", "items": integer(0, MAX_CPUS - 1)},
        "lock_memory": or_variable(json!({"type": "boolean"})),
        "nice": integer(-20, 19),
    })
}

fn edge() -> Value {
    json!({
        "type": "object",
        "required": ["from"],
        "additionalProperties": false,
        "properties": {
            "from": source(),
            "policy": words(&["lossless", "latest"]),
            "capacity": integer(1, MAX_CAPACITY),
            "deadline_ms": or_variable(json!({"type": "number", "exclusiveMinimum": 0, "maximum": HOUR_MILLIS})),
            "on_late": words(&["count", "hold", "stop"]),
            "tolerance_ms": number(0.0, HOUR_MILLIS),
            "partner_wait_ms": number(0.0, HOUR_MILLIS),
        },
    })
}

fn machines() -> Value {
    json!({
        "type": "object",
        "description": "The machines of the graph",
        "minProperties": 1,
        "additionalProperties": {
            "type": ["object", "null"],
            "additionalProperties": false,
            "properties": {
                "listen": texts("Its address for the others: tls/HOST:PORT, unix/NAME or tcp/HOST:PORT"),
            },
        },
    })
}

fn link() -> Value {
    json!({
        "type": ["object", "null"],
        "additionalProperties": false,
        "properties": {
            "keys": {"type": "string", "description": "The folder of keys"},
            "router": texts("A Zenoh router that all machines connect to"),
            "insecure": or_variable(json!({"type": "boolean"})),
            "deadline_ms": integer(MIN_DEADLINE_MILLIS, MAX_DEADLINE_MILLIS),
            "buffer": integer(1, MAX_BUFFER),
        },
    })
}

fn restart_policy() -> Value {
    words(&["on-failure", "always", "never"])
}

fn words(words: &[&str]) -> Value {
    or_variable(json!({"enum": words}))
}

fn source() -> Value {
    or_variable(json!({"type": "string", "pattern": "^[A-Za-z0-9_-]+/[A-Za-z0-9_-]+$"}))
}

fn digest() -> Value {
    or_variable(json!({"type": "string", "pattern": "^[0-9A-Fa-f]{64}$"}))
}

fn name_schema() -> Value {
    // A number is a name, too.
    let pattern = format!("^[A-Za-z0-9_-]{{1,{MAX_NAME_CHARS}}}$");
    or_variable(json!({"type": ["string", "integer"], "pattern": pattern}))
}

fn texts(description: &str) -> Value {
    let text = json!({"type": "string"});
    json!({"description": description, "anyOf": [text, {"type": "array", "items": text}]})
}

fn integer(min: i64, max: i64) -> Value {
    of_kind(&ParamKind::Integer { min: Some(min), max: Some(max) })
}

fn number(min: f64, max: f64) -> Value {
    of_kind(&ParamKind::Number { above: None, min: Some(min), max: Some(max), words: Vec::new() })
}

/// To a definition: one of the file's own has capitals, which no shipped operator has.
fn reference(definition: &str) -> Value {
    json!({"$ref": format!("#/$defs/{definition}")})
}

fn or_variable(value: Value) -> Value {
    json!({"anyOf": [value, reference("VARIABLE")]})
}

fn described(mut schema: Value, description: &str) -> Value {
    if !description.is_empty() {
        schema["description"] = description.into();
    }
    schema
}

#[cfg(test)]
mod tests {
    use super::super::file::FILE_KEYS;
    use super::super::machines_entry::{LINK_KEYS, MACHINE_KEYS};
    use super::super::node::{INPUT_KEYS, NODE_KEYS, RESTART_KEYS};
    use super::super::process_options::SCHEDULING_KEYS;
    use super::*;

    #[test]
    fn the_schema_has_the_keys_of_the_file() {
        let schema = schema(&[]);
        let node = &schema["$defs"]["NODE"]["properties"];
        for (place, known) in [
            (&schema["properties"], &FILE_KEYS[..]),
            (node, &NODE_KEYS),
            (&node["inputs"]["additionalProperties"]["anyOf"][1]["properties"], &INPUT_KEYS),
            (&node["restart"]["anyOf"][1]["properties"], &RESTART_KEYS),
            (&node["scheduling"]["properties"], &SCHEDULING_KEYS),
            (&schema["properties"]["machines"]["additionalProperties"]["properties"], &MACHINE_KEYS),
            (&schema["properties"]["link"]["properties"], &LINK_KEYS),
        ] {
            let mut keys: Vec<&str> = place.as_object().expect("properties").keys().map(String::as_str).collect();
            let mut known = known.to_vec();
            keys.sort_unstable();
            known.sort_unstable();
            assert_eq!(keys, known);
        }
    }
}
