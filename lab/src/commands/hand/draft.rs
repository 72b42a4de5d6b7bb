//! A hand on its way to a layout: the palm frame and the joints that are set before a grasp, where the user gave none.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_operator::text::counted;
use blindgrasp_simulator::mechanism::Mechanism;
use blindgrasp_simulator::pad_grid::{LEAST_TOUCHES, pad_grid};
use blindgrasp_simulator::palm_frame::{
    best_value, idle_pads, odd_joints, opposing_values, pairs_that_meet, palm_fit, self_pressing,
};
use blindgrasp_simulator::planner::PlannerOptions;
use blindgrasp_simulator::touches::{Touch, all_touches, closings};
use blindgrasp_stages::hand::{BareHand, Hand, Joint, Motion, PALM_FRAME, Pad};
use nalgebra::{Isometry3, Point3, Vector3};

use super::{Arguments, NewPad, print_text};

/// A draft must have a score that is better than another's by this much.
const LEAST_GAIN: f64 = 0.05;

/// The hand closes on so many objects to find where it touches them.
const N_CLOSINGS: u64 = 48;

/// Ways to fit a draft are compared by grasps that are the best of so many approaches, in a quarter of the time of the planner's own.
const N_COMPARED: usize = 4;

/// With fewer planned grasps that hold, the hand may be open where it is taken for closed.
const FEW_HELD: usize = 12;

/// A joint of which both limits are as far from the open value closes to the upper one. Opened by this part of its range, it closes
/// to the lower one.
const TURNED: f64 = 0.1;

/// A hand without cells, and the texts that it is made from.
#[derive(Clone)]
pub(super) struct Draft {
    source: PathBuf,
    pub(super) urdf: String,
    pub(super) bare: BareHand,
    pub(super) hand: Hand,
    /// The palm frame that the user gave, in the palm link's.
    palm_pose: Option<[f64; 6]>,
}

/// The open hand that a draft has.
#[derive(Clone, Copy)]
enum Opening {
    AsGiven,
    /// Joints that could close either way are opened by a part of their range.
    TwoWay(f64),
    /// Each joint is open at the limit to which it would close.
    Reversed,
}

/// A way to fit a draft.
#[derive(Clone, Copy)]
struct Way {
    opening: Opening,
    /// Joints that do not close bring pads face to face, as far as they can.
    opposes: bool,
    /// The palm frame is the link's own.
    keeps_frame: bool,
}

/// A draft with a palm frame, how well the hand closes in it, and the lines that tell the choices.
struct Fitted {
    draft: Draft,
    way: Way,
    score: f64,
    /// Planned grasps that hold their objects, as far as they were counted.
    n_held: usize,
    told: Vec<String>,
}

impl Draft {
    pub(super) fn new(
        source: &Path,
        urdf: String,
        bare: BareHand,
        palm_pose: Option<[f64; 6]>,
    ) -> anyhow::Result<Draft> {
        let hand = Hand::without_cells(source, &urdf, &bare)?;
        let mut draft = Draft { source: source.into(), urdf, bare, hand, palm_pose };
        if let Some(pose) = palm_pose {
            draft.put_palm_frame(pose)?;
        }
        Ok(draft)
    }

    /// Moves cells on links without shapes to the link that these are fixed to: makers write a frame for each sensor.
    pub(super) fn move_to_bodies(&mut self, table: &mut [NewPad]) -> anyhow::Result<()> {
        let links = &self.hand.links;
        let mut n_moved = 0;
        for pad in table {
            let Some(mut idx) = links.iter().position(|link| link.name == pad.link) else { continue };
            let frame_idx = idx;
            let mut body_from_link = Isometry3::identity();
            while links[idx].shapes.is_empty()
                && matches!(links[idx].motion, Motion::Fixed)
                && let Some(parent_idx) = links[idx].parent_idx
            {
                body_from_link = links[idx].parent_from_joint * body_from_link;
                idx = parent_idx;
            }
            if idx == frame_idx || links[idx].shapes.is_empty() {
                continue;
            }
            n_moved += 1;
            for cell in &mut pad.cells {
                cell.position_in_link_m = body_from_link * cell.position_in_link_m;
                cell.normal_in_link = body_from_link.rotation * cell.normal_in_link;
                cell.along_in_link = body_from_link.rotation * cell.along_in_link;
            }
            pad.link = links[idx].name.clone();
            self.bare.padded_links.push(pad.link.clone());
        }
        if n_moved == 0 {
            return Ok(());
        }
        print_diagnostic(&format!(
            "the cells of {} lie on links without collision shapes: they belong to the links to which these are fixed",
            counted(n_moved, "pad")
        ));
        self.read()
    }

    /// The pads of the table and of the grids, whose cells lie where the hand touches objects as it closes on them.
    pub(super) fn laid_pads(&self, table: &[NewPad], arguments: &Arguments) -> anyhow::Result<Vec<NewPad>> {
        let mut pads = self.pads(table, arguments, &[])?;
        // The planner comes with the pads to the object, so the pads that lie where it comes are laid twice.
        for n_approaches in [1, PlannerOptions::default().n_approaches] {
            if !arguments.grids.is_empty() {
                let touches = all_touches(closings(&self.with_pads(&pads), 0..N_CLOSINGS, n_approaches)?);
                pads = self.pads(table, arguments, &touches)?;
            }
        }
        for (link, [rows, columns]) in &arguments.grids {
            let n_cells = pads.iter().find(|pad| pad.name == *link).map_or(0, |pad| pad.cells.len());
            let n_missing = (rows * columns).saturating_sub(n_cells);
            if n_missing > 0 {
                print_diagnostic(&format!(
                    "--grid {link}={rows}x{columns}: {n_missing} of {} cells are left out: the link has no face under them",
                    rows * columns
                ));
            }
        }
        Ok(pads)
    }

    /// The pads of the table and of the grids.
    fn pads(&self, table: &[NewPad], arguments: &Arguments, touches: &[Touch]) -> anyhow::Result<Vec<NewPad>> {
        let mechanism = Mechanism::new(&self.hand);
        let mut pads = table.to_vec();
        for (link, [rows, columns]) in &arguments.grids {
            let links = &self.hand.links;
            let known = || links.iter().map(|link| link.name.as_str()).collect::<Vec<_>>().join(", ");
            let link_idx = links.iter().position(|other| other.name == *link);
            let link_idx =
                link_idx.with_context(|| format!("--grid: the URDF has no link '{link}' (it has {})", known()))?;
            let cells = pad_grid(&mechanism, link_idx, [*rows, *columns], touches, arguments.threshold);
            let cells = cells.map_err(|reason| anyhow::anyhow!("--grid {link}: {reason}"))?;
            pads.push(NewPad { name: link.clone(), link: link.clone(), cells });
        }
        Ok(pads)
    }

    /// Finds the palm frame, the open hand and the joints that do not close, where the user gave none, and prints them.
    ///
    /// # Errors
    /// A joint that moves all pads together, as a wrist does.
    pub(super) fn fit(&mut self, table: &[NewPad], arguments: &Arguments) -> anyhow::Result<()> {
        let hand = self.with_pads(&self.pads(table, arguments, &[])?);
        if let Some((joint, link)) = wrist(&hand).filter(|(joint, _)| !arguments.preshape.contains(joint)) {
            bail!("joint '{joint}' moves all pads together, as a wrist does: give the hand alone with --base {link}");
        }
        let given = Way { opening: Opening::AsGiven, opposes: false, keeps_frame: false };
        let mut best = self.fitted(table, arguments, given)?;
        // Joints with as much way to one limit as to the other may close either way.
        if !self.two_way_joints(arguments).is_empty() {
            for opening in [Opening::TwoWay(-0.25), Opening::TwoWay(0.25)] {
                // Another open hand may leave a grid without cells.
                let Ok(other) = self.fitted(table, arguments, Way { opening, ..given }) else { continue };
                if other.score > best.score + LEAST_GAIN {
                    best = other;
                }
            }
        }
        // Balls before the palm do not tell all. 0 is the closed hand of many grippers, and a jaw that closes on a fixed one may
        // hold things with its back. A thumb may lie beside the fingers, and the link's own frame may do better. Planned grasps
        // decide.
        best.n_held = best.draft.held(table, arguments)?;
        if best.n_held < FEW_HELD {
            let reversed = Way { opening: Opening::Reversed, ..best.way };
            self.try_way(reversed, &mut best, table, arguments)?;
        }
        let opposing = Way { opposes: true, ..best.way };
        self.try_way(opposing, &mut best, table, arguments)?;
        if best.draft.bare.palm != self.bare.palm {
            let own = Way { keeps_frame: true, ..best.way };
            self.try_way(own, &mut best, table, arguments)?;
        }
        for line in &best.told {
            print_diagnostic(line);
        }
        *self = best.draft;
        Ok(())
    }

    /// Fits the draft in another way, and takes that if more planned grasps hold, or as many and it closes better on balls.
    fn try_way(&self, way: Way, best: &mut Fitted, table: &[NewPad], arguments: &Arguments) -> anyhow::Result<()> {
        // Not every hand can be reversed, or has joints that bring its pads face to face.
        let Ok(mut other) = self.fitted(table, arguments, way) else { return Ok(()) };
        other.n_held = other.draft.held(table, arguments)?;
        let is_as_good = way.keeps_frame || other.score > best.score;
        if other.n_held > best.n_held || other.n_held == best.n_held && is_as_good {
            *best = other;
        }
        Ok(())
    }

    /// How many planned grasps hold their objects.
    fn held(&self, table: &[NewPad], arguments: &Arguments) -> anyhow::Result<usize> {
        let hand = self.with_pads(&self.pads(table, arguments, &[])?);
        let closings = closings(&hand, 0..N_CLOSINGS, N_COMPARED)?;
        Ok(closings.iter().filter(|closing| closing.is_held).count())
    }

    /// Names of closing joints whose limits are as far from the open value on both sides, and whose open value nobody gave.
    fn two_way_joints(&self, arguments: &Arguments) -> Vec<String> {
        let is_two_way = |joint: &&Joint| {
            let (below, above) = (joint.open() - joint.lower, joint.upper - joint.open());
            let is_given = arguments.open.iter().any(|(name, _)| *name == joint.name);
            !joint.is_preshape && !is_given && below > 0.8 * above && above > 0.8 * below
        };
        self.hand.joints.iter().filter(is_two_way).map(|joint| joint.name.clone()).collect()
    }

    /// The draft with an open hand, its palm frame and the joints that do not close.
    fn fitted(&self, table: &[NewPad], arguments: &Arguments, way: Way) -> anyhow::Result<Fitted> {
        let mut fitted = Fitted { draft: self.clone(), way, score: 0.0, n_held: 0, told: Vec::new() };
        if let Opening::Reversed = way.opening {
            fitted.open_reversed(arguments)?;
        }
        let still = fitted.keep_still(table, arguments)?;
        if let Opening::TwoWay(part) = way.opening {
            fitted.open_two_way(part, arguments)?;
        }
        if way.opposes {
            fitted.oppose(&still, table, arguments)?;
        }
        if !way.keeps_frame {
            fitted.find_palm_frame(table, arguments)?;
        }
        fitted.set_still(&still, table, arguments)?;
        Ok(fitted)
    }

    /// Says which pads come to no object or lie inside another link, and whether the hand closes on itself.
    pub(super) fn warn(&self, pads: &[NewPad]) -> anyhow::Result<()> {
        let hand = self.with_pads(pads);
        for (pad, n_inside, link) in buried_pads(&hand)? {
            print_diagnostic(&format!(
                "{n_inside} of the {} cells of pad '{}' lie inside the collision shapes of link '{link}' while the hand is open, \
                 where they feel nothing: a link that only keeps a robot's distance does not belong into the URDF",
                pad.cells.len(),
                pad.name
            ));
        }
        let moving = hand.with_moving_pads();
        let fit = idle_pads(&moving)?;
        if !fit.is_empty() {
            let names: Vec<&str> = fit.iter().map(|idx| moving.pads[*idx].name.as_str()).collect();
            print_diagnostic(&format!(
                "the hand closes on balls of 40 and 70 mm before its palm, and these pads come near to none: {}; expected \
                 joints that close towards the palm (--open), or another palm frame (--palm-pose)",
                names.join(", ")
            ));
        }
        let (share, pair) = self_pressing(&hand)?;
        if let Some((a, b)) = pair
            && share > 0.5
        {
            print_diagnostic(&format!(
                "links press on each other in {:.0} % of the postures until the hand is half closed, mostly '{}' on '{}': give \
                 an open hand with --open, keep joints still with --preshape, or simplify the collision shapes",
                100.0 * share,
                hand.links[a].name,
                hand.links[b].name
            ));
        }
        let mut met = Vec::new();
        for (a, b) in pairs_that_meet(&hand)? {
            met.push(format!("{} and {}", hand.links[a].name, hand.links[b].name));
        }
        if !met.is_empty() {
            print_diagnostic(&format!(
                "as the hand closes on balls, links with pads touch other links, where their cells count as no contact: {}",
                met.join("; ")
            ));
        }
        Ok(())
    }

    /// Prints the share of planned closings that a cell feels, and names the pads that feel less than half of their link's
    /// contacts.
    pub(super) fn tell_felt(&self, pads: &[NewPad]) -> anyhow::Result<()> {
        let hand = self.with_pads(pads);
        // The cells and the frame were chosen by the first ones.
        let closings = closings(&hand, N_CLOSINGS..2 * N_CLOSINGS, PlannerOptions::default().n_approaches)?;
        let n_felt = closings.iter().filter(|closing| closing.touches.iter().any(|touch| touch.is_felt)).count();
        let n_held = closings.iter().filter(|closing| closing.is_held).count();
        let n_touching = closings.len();
        print_text(&format!(
            "\nof {N_CLOSINGS} planned grasps of other training objects, {n_touching} touch the object, a cell feels {n_felt}, and \
             {n_held} hold it"
        ))?;
        if n_held == 0 {
            print_diagnostic(
                "no planned grasp holds: expected fingers that close towards each other (--open, --preshape, --palm-pose)",
            );
        }
        // The links without cells on which grasps are not felt.
        let mut bare: BTreeMap<usize, usize> = BTreeMap::new();
        for closing in closings.iter().filter(|closing| !closing.touches.iter().any(|touch| touch.is_felt)) {
            let links: BTreeSet<usize> = closing.touches.iter().map(|touch| touch.link_idx).collect();
            for link_idx in links.into_iter().filter(|idx| !hand.pads.iter().any(|pad| pad.link_idx == *idx)) {
                *bare.entry(link_idx).or_default() += 1;
            }
        }
        if let Some((link_idx, n)) = bare.into_iter().max_by_key(|(_, n)| *n).filter(|(_, n)| *n >= LEAST_TOUCHES) {
            let link = &hand.links[link_idx].name;
            print_diagnostic(&format!(
                "{n} grasps that no cell feels touch link '{link}', which has no cells: --grid {link}=3x3 lays some there"
            ));
        }
        let touches = all_touches(closings);
        let mut told = BTreeSet::new();
        for pad in &hand.pads {
            let on_link: Vec<&Touch> = touches.iter().filter(|touch| touch.link_idx == pad.link_idx).collect();
            let unfelt: Vec<&&Touch> = on_link.iter().filter(|touch| !touch.is_felt).collect();
            // Too few contacts say nothing of where others would lie.
            if unfelt.len() < LEAST_TOUCHES || 2 * unfelt.len() <= on_link.len() || !told.insert(pad.link_idx) {
                continue;
            }
            let middle =
                unfelt.iter().map(|touch| touch.point_in_link_m.coords).sum::<Vector3<f64>>() / unfelt.len() as f64;
            let [x, y, z] = [middle.x, middle.y, middle.z].map(|metres| round(metres, 1e3));
            print_diagnostic(&format!(
                "the cells on link '{}' feel {} of its {} contacts: those unfelt lie around [{x}, {y}, {z}] m in the link's frame; \
                 lay cells there (--cells), more of them (--grid), or use a link that meets the object first",
                hand.links[pad.link_idx].name,
                on_link.len() - unfelt.len(),
                on_link.len()
            ));
        }
        Ok(())
    }

    fn read(&mut self) -> anyhow::Result<()> {
        self.hand = Hand::without_cells(&self.source, &self.urdf, &self.bare)?;
        Ok(())
    }

    /// Adds a link at a pose of the palm link to the URDF.
    fn put_palm_frame(&mut self, [x, y, z, roll, pitch, yaw]: [f64; 6]) -> anyhow::Result<()> {
        let palm = self.hand.palm_link().name.clone();
        let end = self.urdf.rfind("</robot>").context("the URDF does not end with </robot>")?;
        // The URDF of a hand that was made by this command has such a link already.
        let mut frame = PALM_FRAME.to_owned();
        while self.hand.links.iter().any(|link| link.name == frame) {
            frame.push('_');
        }
        self.urdf.insert_str(
            end,
            &format!(
                "  <link name=\"{frame}\"/>\n  <joint name=\"{frame}_joint\" type=\"fixed\">\n    \
                 <parent link=\"{palm}\"/><child link=\"{frame}\"/>\n    <origin xyz=\"{x} {y} {z}\" rpy=\"{roll} {pitch} \
                 {yaw}\"/>\n  </joint>\n"
            ),
        );
        self.bare.palm = Some(frame);
        self.read()
    }

    /// The hand with these pads; a pad on an unknown link, which is refused later, is left out.
    fn with_pads(&self, pads: &[NewPad]) -> Hand {
        let mut hand = self.hand.clone();
        let mut first_cell_idx = 0;
        for pad in pads {
            let Some(link_idx) = hand.links.iter().position(|link| link.name == pad.link) else { continue };
            let cells = pad.cells.clone();
            let n_cells = cells.len();
            let name = pad.name.clone();
            hand.pads.push(Pad { name, link_idx, first_cell_idx, cells, ..Pad::default() });
            first_cell_idx += n_cells;
        }
        hand
    }
}

impl Fitted {
    /// Opens each joint at the limit to which it would close, unless the user gave its open value.
    fn open_reversed(&mut self, arguments: &Arguments) -> anyhow::Result<()> {
        let mut opened = Vec::new();
        for joint in &self.draft.hand.joints {
            if !joint.is_preshape && !arguments.open.iter().any(|(name, _)| *name == joint.name) {
                opened.push((joint.name.clone(), joint.closed()));
            }
        }
        if opened.is_empty() {
            bail!("every joint has its open value, or is set before a grasp");
        }
        self.told
            .push(format!("the hand is open where it could be taken for closed: as by --open {}", listed(&opened)));
        self.draft.bare.open.extend(opened);
        self.draft.read()
    }

    /// Finds the joints that do not close, and turns those that can close the other way.
    fn keep_still(&mut self, table: &[NewPad], arguments: &Arguments) -> anyhow::Result<Vec<usize>> {
        let Fitted { draft, told, .. } = self;
        let (mut still, mut turned) = (Vec::new(), Vec::new());
        if arguments.preshape.is_empty() {
            let hand = draft.with_pads(&draft.pads(table, arguments, &[])?);
            let odd = odd_joints(&hand)?;
            let two_way = draft.two_way_joints(arguments);
            still = odd.sideways;
            for idx in odd.opposed {
                let joint = &hand.joints[idx];
                // A joint that turns back and can close the other way does so.
                if two_way.contains(&joint.name) {
                    let value = round(joint.open() + TURNED * (joint.upper - joint.lower), 1e4);
                    turned.push((joint.name.clone(), value));
                    draft.bare.open.insert(joint.name.clone(), value);
                } else {
                    still.push(idx);
                }
            }
            still.retain(|idx| !arguments.open.iter().any(|(name, _)| *name == hand.joints[*idx].name));
            // A hand that closes with no joint at all is judged wrongly.
            if still.len() == hand.joints.len() {
                still.clear();
            }
        }
        if !turned.is_empty() {
            told.push(format!("these joints close towards their lower limits: as by --open {}", listed(&turned)));
        }
        for idx in &still {
            let joint = &draft.hand.joints[*idx];
            draft.bare.preshape_joints.push(joint.name.clone());
            draft.bare.open.insert(joint.name.clone(), joint.open());
        }
        draft.read()?;
        Ok(still)
    }

    /// Opens the joints that could close either way by a part of their range.
    fn open_two_way(&mut self, part: f64, arguments: &Arguments) -> anyhow::Result<()> {
        let Fitted { draft, told, .. } = self;
        let mut opened = Vec::new();
        for name in draft.two_way_joints(arguments) {
            let joint = draft.hand.joint_idx(&name).map(|idx| &draft.hand.joints[idx]).context("a joint")?;
            opened.push((name, round(joint.open() + part * (joint.upper - joint.lower), 1e4)));
        }
        told.push(format!("these joints could close either way: the hand closes as by --open {}", listed(&opened)));
        draft.bare.open.extend(opened);
        draft.read()
    }

    /// Sets joints that do not close to the values with which pads come face to face.
    fn oppose(&mut self, still: &[usize], table: &[NewPad], arguments: &Arguments) -> anyhow::Result<()> {
        let draft = &mut self.draft;
        let hand = draft.with_pads(&draft.pads(table, arguments, &[])?).with_moving_pads();
        let values = opposing_values(&hand, still)?.context("no other values bring pads face to face")?;
        for (joint_idx, value) in values {
            let joint = &hand.joints[joint_idx];
            draft.bare.open.insert(joint.name.clone(), round(value, 1e4).clamp(joint.lower, joint.upper));
        }
        draft.read()
    }

    /// Finds the palm frame in which the hand closes best, and takes it unless the user gave one.
    fn find_palm_frame(&mut self, table: &[NewPad], arguments: &Arguments) -> anyhow::Result<()> {
        let Fitted { draft, told, score, .. } = self;
        let palm = draft.hand.palm_link().name.clone();
        let hand = draft.with_pads(&draft.pads(table, arguments, &[])?).with_moving_pads();
        let fit = palm_fit(&hand)?;
        *score = fit.score;
        let pose = rounded(&fit.link_from_palm);
        if let Some(given) = draft.palm_pose
            && fit.is_better
        {
            let better = rounded(&(isometry(given) * fit.link_from_palm)).map(|number| number.to_string()).join(",");
            told.push(format!(
                "the hand closes on an object before --palm-pose {better}, not before the one that is given"
            ));
        } else if fit.is_better && pose != [0.0; 6] {
            let text = pose.map(|number| number.to_string()).join(",");
            told.push(format!(
                "the hand closes on an object before --palm {palm} --palm-pose {text}, not before +z of link '{palm}': the layout \
                 has that palm frame; give --palm {palm} --palm-pose 0,0,0,0,0,0 to keep the link's own"
            ));
            draft.put_palm_frame(pose)?;
        }
        Ok(())
    }

    /// Sets the joints that do not close to the values with which the hand closes best, unless pads are to come face to face.
    fn set_still(&mut self, still: &[usize], table: &[NewPad], arguments: &Arguments) -> anyhow::Result<()> {
        let Fitted { draft, told, way, .. } = self;
        let mut values = Vec::new();
        for idx in still {
            let joint = &draft.hand.joints[*idx];
            let name = joint.name.clone();
            if way.opposes {
                values.push((name, joint.open()));
                continue;
            }
            let hand = draft.with_pads(&draft.pads(table, arguments, &[])?).with_moving_pads();
            let value = round(best_value(&hand, *idx)?, 1e4).clamp(joint.lower, joint.upper);
            values.push((name.clone(), value));
            draft.bare.open.insert(name, value);
            draft.read()?;
        }
        if !values.is_empty() {
            told.push(format!(
                "these joints move no pad towards an object, so they are set before a grasp and do not close: as by --preshape \
                 {} --open {}",
                draft.bare.preshape_joints.join(","),
                listed(&values)
            ));
        }
        Ok(())
    }
}

/// Pads of which more than half of the cells lie inside the shapes of another link while the hand is open, with their number.
fn buried_pads(hand: &Hand) -> anyhow::Result<Vec<(&Pad, usize, &str)>> {
    let palm_from_links = hand.palm_from_links(&hand.open_joints())?;
    let mut buried = Vec::new();
    for pad in &hand.pads {
        let others = (0..hand.links.len()).filter(|idx| *idx != pad.link_idx);
        buried.extend(others.filter_map(|idx| {
            let is_inside = |point: Point3<f64>| hand.distance_to_link_m(&point, idx, &palm_from_links) == 0.0;
            let points = pad.cells.iter().map(|cell| palm_from_links[pad.link_idx] * cell.position_in_link_m);
            let n_inside = points.filter(|point| is_inside(*point)).count();
            (2 * n_inside > pad.cells.len()).then_some((pad, n_inside, hand.links[idx].name.as_str()))
        }));
    }
    Ok(buried)
}

/// A joint that moves all pads as one, where they lie on several links that move against each other, and the link that it moves.
fn wrist(hand: &Hand) -> Option<(String, String)> {
    let movers = |link_idx: usize| {
        let above = std::iter::successors(Some(link_idx), |idx| hand.links[*idx].parent_idx);
        above.filter(|idx| matches!(hand.links[*idx].motion, Motion::Joint { .. })).collect::<Vec<_>>()
    };
    let chains: Vec<Vec<usize>> = hand.pads.iter().map(|pad| movers(pad.link_idx)).collect();
    let (first, others) = chains.split_first()?;
    let lowest = *first.iter().find(|idx| others.iter().all(|chain| chain.contains(idx)))?;
    // The links on it that move the pads. Of one finger there is one; a palm bears several fingers.
    let mut borne: BTreeSet<usize> = BTreeSet::new();
    for chain in &chains {
        borne.extend(chain.iter().take_while(|idx| **idx != lowest).last());
    }
    let Motion::Joint { joint_idx, .. } = hand.links[lowest].motion else { return None };
    (borne.len() > 1).then(|| (hand.joints[joint_idx].name.clone(), hand.links[lowest].name.clone()))
}

fn isometry([x, y, z, roll, pitch, yaw]: [f64; 6]) -> Isometry3<f64> {
    Isometry3::from_parts([x, y, z].into(), nalgebra::UnitQuaternion::from_euler_angles(roll, pitch, yaw))
}

/// X, Y, Z in millimetres' precision, roll, pitch and yaw.
fn rounded(pose: &Isometry3<f64>) -> [f64; 6] {
    let t = &pose.translation.vector;
    let (roll, pitch, yaw) = pose.rotation.euler_angles();
    [round(t.x, 1e3), round(t.y, 1e3), round(t.z, 1e3), round(roll, 1e4), round(pitch, 1e4), round(yaw, 1e4)]
}

/// `JOINT=VALUE,…`, as --open takes it.
fn listed(values: &[(String, f64)]) -> String {
    values.iter().map(|(name, value)| format!("{name}={value}")).collect::<Vec<_>>().join(",")
}

fn round(value: f64, per_unit: f64) -> f64 {
    // Adding 0 makes a 0 of a -0.
    (value * per_unit).round() / per_unit + 0.0
}
