//! One advice per grasp, from the features of its frames.

use serde::{Deserialize, Serialize};

use crate::regrasp::advisor::Advisor;
use blindgrasp_messages::{Fault, GraspFeature, Header, Phase, RegraspAdvice};

/// Gives one advice for each grasp: after enough settled frames, or at the grasp's end.
#[derive(Debug, Clone)]
pub struct AdviceStage {
    advisor: Advisor,
    /// Number of settled frames with a feature that are enough.
    n_settled: u32,
    state: AdviceState,
}

/// The state between samples.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct AdviceState {
    grasp: Option<OpenGrasp>,
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct OpenGrasp {
    epoch: u64,
    grasp_id: u64,
    /// The number of settled frames with a feature; `sums` adds up their features.
    n_settled: u32,
    sums: Vec<f64>,
    is_advised: bool,
}

impl AdviceStage {
    /// Advice after so many settled frames, at least 1.
    pub fn new(advisor: Advisor, n_settled: u32) -> Self {
        AdviceStage { advisor, n_settled: n_settled.max(1), state: AdviceState::default() }
    }

    /// Takes the feature of a frame, and pushes the advice that is due.
    pub fn on_feature(&mut self, header: &Header, feature: &GraspFeature, advice: &mut Vec<RegraspAdvice>) {
        let is_of_open = |grasp: &OpenGrasp| (grasp.epoch, grasp.grasp_id) == (header.epoch, feature.grasp_id);
        if !self.state.grasp.as_ref().is_some_and(is_of_open) {
            advice.extend(self.on_end());
            self.state.grasp =
                Some(OpenGrasp { epoch: header.epoch, grasp_id: feature.grasp_id, ..OpenGrasp::default() });
        }
        let Some(grasp) = &mut self.state.grasp else { return };
        let experience = self.advisor.experience();
        let is_known = feature.fault == Fault::None
            && feature.dictionary_id == experience.dictionary_id
            && header.hand_id == experience.hand.id
            && feature.values.len() == experience.scaling.mean.len()
            && feature.values.iter().all(|value| value.is_finite());
        if feature.phase == Phase::Settled && is_known && !grasp.is_advised {
            grasp.sums.resize(feature.values.len(), 0.0);
            grasp.sums.iter_mut().zip(&feature.values).for_each(|(sum, value)| *sum += value);
            grasp.n_settled += 1;
        }
        if grasp.n_settled >= self.n_settled || feature.phase.is_over() {
            advice.extend(self.advise());
        }
    }

    /// The advice that is due at the end of the stream.
    pub fn on_end(&mut self) -> Option<RegraspAdvice> {
        self.advise()
    }

    /// For the instance that takes over.
    pub fn state(&self) -> &AdviceState {
        &self.state
    }

    /// Continues from a state.
    pub fn restore(&mut self, state: AdviceState) {
        self.state = state;
    }

    fn advise(&mut self) -> Option<RegraspAdvice> {
        let grasp = self.state.grasp.as_mut().filter(|grasp| !grasp.is_advised)?;
        grasp.is_advised = true;
        let n_settled = f64::from(grasp.n_settled);
        // Without a feature there are no proposals, but the advice is sent, because others wait for it.
        let proposals = match grasp.n_settled {
            0 => Vec::new(),
            _ => self.advisor.advise(&grasp.sums.drain(..).map(|sum| sum / n_settled).collect::<Vec<f64>>()),
        };
        Some(RegraspAdvice { grasp_id: grasp.grasp_id, proposals })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::regrasp::advisor::tests::{options, two_objects};

    fn stage() -> AdviceStage {
        AdviceStage::new(Advisor::new(two_objects(), options()), 3)
    }

    fn header() -> Header {
        Header { hand_id: 7, epoch: 1, ..Header::default() }
    }

    fn feature(grasp_id: u64, phase: Phase) -> GraspFeature {
        let values = vec![0.5, 0.0];
        GraspFeature { grasp_id, phase, values, dictionary_id: 0xabc, ..GraspFeature::default() }
    }

    /// Which grasps are advised at each of these, and with how many proposals at least one.
    fn said(stage: &mut AdviceStage, features: &[GraspFeature]) -> Vec<Vec<(u64, bool)>> {
        let of = |advice: &RegraspAdvice| (advice.grasp_id, !advice.proposals.is_empty());
        let mut said = Vec::new();
        for feature in features {
            let mut advice = Vec::new();
            stage.on_feature(&header(), feature, &mut advice);
            said.push(advice.iter().map(of).collect());
        }
        said.push(stage.on_end().iter().map(of).collect());
        said
    }

    #[test]
    fn each_grasp_is_advised_once() {
        use Phase::{Closing, Ended, Open, Settled};
        let phases = [Open, Settled, Settled, Settled, Settled, Ended];
        let found = said(&mut stage(), &phases.map(|phase| feature(4, phase)));
        assert_eq!(found, [vec![], vec![], vec![], vec![(4, true)], vec![], vec![], vec![]]);
        // Fewer settled frames: at its end, however that is known.
        let found = said(&mut stage(), &[Settled, Settled, Ended].map(|phase| feature(4, phase)));
        assert_eq!(found, [vec![], vec![], vec![(4, true)], vec![]]);
        let found = said(&mut stage(), &[feature(4, Settled), feature(5, Open), feature(5, Closing)]);
        assert_eq!(found, [vec![], vec![(4, true)], vec![], vec![(5, false)]]);
    }

    #[test]
    fn what_is_no_feature_of_its_model_brings_no_proposals() {
        let good = feature(4, Phase::Settled);
        for bad in [
            GraspFeature { fault: Fault::NoContact, values: vec![], ..good.clone() },
            GraspFeature { dictionary_id: 1, ..good.clone() },
            GraspFeature { values: vec![1.0], ..good.clone() },
            GraspFeature { values: vec![1.0, f64::NAN], ..good.clone() },
        ] {
            let found = said(&mut stage(), &[bad.clone(), bad.clone(), bad]);
            assert_eq!(found, [vec![], vec![], vec![], vec![(4, false)]]);
        }
    }

    #[test]
    fn one_that_takes_over_says_the_same() {
        let mut first = stage();
        let mut advice = Vec::new();
        let settled = feature(4, Phase::Settled);
        for _ in 0..2 {
            first.on_feature(&header(), &settled, &mut advice);
        }
        let mut second = stage();
        second.restore(first.state().clone());
        first.on_feature(&header(), &settled, &mut advice);
        second.on_feature(&header(), &settled, &mut advice);
        assert_eq!(advice.len(), 2);
        assert_eq!(advice[0], advice[1]);
        second.on_feature(&header(), &settled, &mut advice);
        assert_eq!((advice.len(), second.on_end()), (2, None));
    }
}
