//! A hand on its way to a layout: the palm frame and the joints that are set before a grasp, where the user gave none.

use std::fmt::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use blindgrasp_operator::diagnostics::print_diagnostic;
use blindgrasp_simulator::mechanism::Mechanism;
use blindgrasp_simulator::pad_grid::pad_grid;
use blindgrasp_simulator::palm_frame::{best_value, idle_pads, joints_that_do_not_close, palm_fit, self_pressing};
use blindgrasp_stages::hand::{BareHand, Hand, PALM_FRAME, Pad};
use nalgebra::Isometry3;

use super::{Arguments, NewPad};

/// A hand without cells, and the texts that it is made from.
pub(super) struct Draft {
    source: PathBuf,
    pub(super) urdf: String,
    pub(super) bare: BareHand,
    pub(super) hand: Hand,
    has_palm_pose: bool,
}

impl Draft {
    pub(super) fn new(
        source: &Path,
        urdf: String,
        bare: BareHand,
        palm_pose: Option<[f64; 6]>,
    ) -> anyhow::Result<Draft> {
        let hand = Hand::without_cells(source, &urdf, &bare)?;
        let mut draft = Draft { source: source.into(), urdf, bare, hand, has_palm_pose: palm_pose.is_some() };
        if let Some(pose) = palm_pose {
            draft.put_palm_frame(pose)?;
        }
        Ok(draft)
    }

    /// The pads of the table and of the grids.
    pub(super) fn pads(
        &self,
        table: &[NewPad],
        arguments: &Arguments,
        tells_missing: bool,
    ) -> anyhow::Result<Vec<NewPad>> {
        let mechanism = Mechanism::new(&self.hand);
        let mut pads = table.to_vec();
        for (link, [rows, columns]) in &arguments.grids {
            let links = &self.hand.links;
            let known = || links.iter().map(|link| link.name.as_str()).collect::<Vec<_>>().join(", ");
            let link_idx = links.iter().position(|other| other.name == *link);
            let link_idx =
                link_idx.with_context(|| format!("--grid: the URDF has no link '{link}' (it has {})", known()))?;
            let cells = pad_grid(&mechanism, link_idx, [*rows, *columns], arguments.threshold);
            let cells = cells.map_err(|reason| anyhow::anyhow!("--grid {link}: {reason}"))?;
            let n_missing = rows * columns - cells.len();
            if n_missing > 0 && tells_missing {
                print_diagnostic(&format!(
                    "--grid {link}={rows}x{columns}: {n_missing} of {} cells are left out: the link has no face under them",
                    rows * columns
                ));
            }
            pads.push(NewPad { name: link.clone(), link: link.clone(), cells });
        }
        Ok(pads)
    }

    /// Finds the palm frame and the joints that do not close, if the user named none, and says what it found.
    pub(super) fn fit(&mut self, table: &[NewPad], arguments: &Arguments) -> anyhow::Result<()> {
        let mut still = Vec::new();
        if arguments.preshape.is_empty() {
            let names: Vec<&str> = arguments.open.iter().map(|(name, _)| name.as_str()).collect();
            let hand = self.with_pads(&self.pads(table, arguments, false)?);
            still = joints_that_do_not_close(&hand)?;
            still.retain(|idx| !names.contains(&hand.joints[*idx].name.as_str()));
            // A hand that closes with no joint at all is judged wrongly.
            if still.len() == hand.joints.len() {
                still.clear();
            }
        }
        for idx in &still {
            let joint = &self.hand.joints[*idx];
            self.bare.preshape_joints.push(joint.name.clone());
            self.bare.open.insert(joint.name.clone(), joint.open());
        }
        self.read()?;
        let palm = self.hand.palm_link().name.clone();
        if !self.has_palm_pose {
            let hand = self.with_pads(&self.pads(table, arguments, false)?);
            let fit = palm_fit(&hand.with_moving_pads())?;
            if fit.is_better {
                let pose = rounded(&fit.link_from_palm);
                let text = pose.map(|number| number.to_string()).join(",");
                print_diagnostic(&format!(
                    "the hand closes on an object before --palm {palm} --palm-pose {text}, not before +z of link '{palm}': \
                     the layout has that palm frame; give --palm {palm} --palm-pose 0,0,0,0,0,0 to keep the link's own"
                ));
                self.put_palm_frame(pose)?;
            }
        }
        let mut told = String::new();
        for idx in still {
            let hand = self.with_pads(&self.pads(table, arguments, false)?).with_moving_pads();
            let value = round(best_value(&hand, idx)?, 1e4);
            let name = self.hand.joints[idx].name.clone();
            let _ = write!(told, "{}{name}={value}", if told.is_empty() { "" } else { "," });
            self.bare.open.insert(name, value);
            self.read()?;
        }
        if !told.is_empty() {
            print_diagnostic(&format!(
                "these joints move no pad towards an object, so they are set before a grasp and do not close: as by --preshape {} \
                 --open {told}",
                self.bare.preshape_joints.join(",")
            ));
        }
        Ok(())
    }

    /// Says which pads come to no object, and whether the hand closes on itself.
    pub(super) fn warn(&self, pads: &[NewPad]) -> anyhow::Result<()> {
        let hand = self.with_pads(pads);
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
        if let Some((a, b)) = pair.filter(|_| share > 0.5) {
            print_diagnostic(&format!(
                "links press on each other in {:.0} % of the postures until the hand is half closed, mostly '{}' on '{}': give \
                 an open hand with --open, keep joints still with --preshape, or simplify the collision shapes",
                100.0 * share,
                hand.links[a].name,
                hand.links[b].name
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
        self.urdf.insert_str(
            end,
            &format!(
                "  <link name=\"{PALM_FRAME}\"/>\n  <joint name=\"{PALM_FRAME}_joint\" type=\"fixed\">\n    \
                 <parent link=\"{palm}\"/><child link=\"{PALM_FRAME}\"/>\n    <origin xyz=\"{x} {y} {z}\" rpy=\"{roll} {pitch} \
                 {yaw}\"/>\n  </joint>\n"
            ),
        );
        self.bare.palm = Some(PALM_FRAME.into());
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
            hand.pads.push(Pad { name: pad.name.clone(), link_idx, first_cell_idx, cells });
            first_cell_idx += n_cells;
        }
        hand
    }
}

/// X, Y, Z in millimetres' precision, roll, pitch and yaw.
fn rounded(pose: &Isometry3<f64>) -> [f64; 6] {
    let t = &pose.translation.vector;
    let (roll, pitch, yaw) = pose.rotation.euler_angles();
    [round(t.x, 1e3), round(t.y, 1e3), round(t.z, 1e3), round(roll, 1e4), round(pitch, 1e4), round(yaw, 1e4)]
}

fn round(value: f64, per_unit: f64) -> f64 {
    // Adding 0 makes a 0 of a -0.
    (value * per_unit).round() / per_unit + 0.0
}
