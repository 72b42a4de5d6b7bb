//! The model of a graph as its page shows it: thresholds, the parts of a feature, and the words of its dictionary.

use std::path::Path;

use anyhow::Context;
use blindgrasp_graph::control::GraphStatus;
use blindgrasp_messages::GraspFeature;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_stages::Hand;
use blindgrasp_stages::encoder::Block;
use blindgrasp_stages::model::Model;
use serde_json::{Value, json};

/// The model of the first node that has one; it is read again after a swap.
#[derive(Default)]
pub(super) struct ShownModel {
    /// The file and how often the node was swapped and started again, once the graph was looked at.
    source: Option<Option<(String, u32)>>,
    model: Option<Model>,
}

impl ShownModel {
    /// Reads the model of a graph, if it is another one than before; an event for the page if so. A model that cannot be read is
    /// said, and the page is without.
    pub(super) fn update(&mut self, status: &GraphStatus) -> Option<String> {
        // The thresholds are those of the classifier.
        let classifier = status.nodes.iter().find(|status| status.node == "classifier");
        let nodes = classifier.into_iter().chain(&status.nodes);
        let source = nodes
            .into_iter()
            .find_map(|node| Some((node.params.get("model")?.as_str()?.to_owned(), node.n_swaps + node.n_restarts)));
        if self.source.as_ref() == Some(&source) {
            return None;
        }
        let path = source.as_ref().map(|(path, _)| Path::new(path));
        self.model = path.and_then(|path| match Model::load(path).with_context(|| path.display().to_string()) {
            Ok(model) => Some(model),
            Err(error) => {
                print_diagnostic(&format!("the page shows no model: {error:#}"));
                None
            }
        });
        self.source = Some(source);
        Some(self.event().to_string())
    }

    /// The two values of a settled feature that speak most against the grasp.
    pub(super) fn speak_against(&self, hand: &Hand, feature: &GraspFeature) -> Option<String> {
        let model = self.model.as_ref().filter(|model| model.dictionary_id() == feature.dictionary_id)?;
        model.speak_against(&model.features.value_names(hand), &feature.values)
    }

    fn event(&self) -> Value {
        let Some(Model { features, classifier, .. }) = &self.model else { return Value::Null };
        let blocks = features.blocks.iter().map(|block| json!({"name": block, "n_values": features.block_len(*block)}));
        json!({
            "threshold": classifier.threshold_probability,
            "unsure_from": classifier.unsure_from_probability,
            "blocks": blocks.collect::<Vec<_>>(),
            "words_m": if features.blocks.contains(&Block::Histogram) { &features.dictionary.words_m[..] } else { &[] },
        })
    }

    /// The weight of each word in a feature of this model, without the scaling of values; empty without a histogram.
    pub(super) fn words(&self, dictionary_id: u64, values: &[f64]) -> Vec<f64> {
        let Some(model) = self.model.as_ref().filter(|model| model.dictionary_id() == dictionary_id) else {
            return Vec::new();
        };
        let features = &model.features;
        if values.len() != features.len() {
            return Vec::new();
        }
        let Some(at) = features.blocks.iter().position(|block| *block == Block::Histogram) else { return Vec::new() };
        let first: usize = features.blocks[..at].iter().map(|block| features.block_len(*block)).sum();
        let words = first..first + features.dictionary.len();
        words.map(|idx| features.unscaled(idx, values[idx])).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_words_of_a_scaled_feature_are_the_histogram() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/barrett-bh8-280.json");
        let model = Model::load(&path).expect("a model");
        let (id, features) = (model.dictionary_id(), model.features.clone());
        let shown = ShownModel { source: None, model: Some(model) };
        let n_words = features.dictionary.len();
        let words: Vec<f64> = (0..n_words).map(|word| word as f64 / 10.0).collect();
        let at = features.blocks.iter().position(|block| *block == Block::Histogram).expect("a histogram");
        let first: usize = features.blocks[..at].iter().map(|block| features.block_len(*block)).sum();
        let mut values = vec![0.0; features.len()];
        values[first..first + n_words].copy_from_slice(&words);
        if let Some(scaling) = &features.scaling {
            scaling.apply(&mut values);
        }
        let found = shown.words(id, &values);
        assert!(found.len() == n_words && found.iter().zip(&words).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}");
        assert!(shown.words(id + 1, &values).is_empty() && shown.words(id, &values[1..]).is_empty());
        assert_eq!(shown.event()["words_m"].as_array().map(Vec::len), Some(n_words));
    }
}
