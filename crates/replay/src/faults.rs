//! Faults of sensors and transports, put into the frames of recorded grasps.

use std::collections::BTreeMap;
use std::path::Path;

use serde::Serialize;

use blindgrasp_messages::{Phase, Stamped, TactileFrame};
use blindgrasp_recording::{Record, RecordingError, RecordingReader, RecordingWriter};

/// A fault that each grasp of a recording meets. Grasps that never settle stay as they are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum InjectedFault {
    /// The second settled frame is lost.
    LostFrame,
    /// Every third frame is lost.
    DropOuts,
    /// The first settled frame comes twice.
    DoubledFrame,
    /// The first settled frame comes after the second.
    LateFrame,
    /// In the second settled frame, all cells read 0.
    SilentFrame,
    /// In the second settled frame, the most loaded cell reads NaN.
    NanReading,
    /// The cell that is most loaded when the hand settles reads 0 throughout.
    DeadCell,
    /// It reads throughout what it reads when the hand settles.
    StuckCell,
    /// All cells of the pad that is most loaded when the hand settles read 0 throughout.
    DeadPad,
}

impl InjectedFault {
    /// All faults, each with its words for a person.
    pub const ALL: [(InjectedFault, &str); 9] = [
        (InjectedFault::LostFrame, "the second settled frame is lost"),
        (InjectedFault::DropOuts, "every third frame is lost"),
        (InjectedFault::DoubledFrame, "the first settled frame comes twice"),
        (InjectedFault::LateFrame, "the first settled frame comes after the second"),
        (InjectedFault::SilentFrame, "all cells read 0 in the second settled frame"),
        (InjectedFault::NanReading, "a cell reads NaN in the second settled frame"),
        (InjectedFault::DeadCell, "the most loaded cell reads 0"),
        (InjectedFault::StuckCell, "the most loaded cell is stuck"),
        (InjectedFault::DeadPad, "the most loaded pad reads 0"),
    ];

    /// Puts the fault into the frames of a grasp. `pad_of_cell` has the index of each cell's pad.
    pub fn apply(self, frames: &mut Vec<Stamped<TactileFrame>>, pad_of_cell: &[usize]) {
        let is_settled = |frame: &Stamped<TactileFrame>| frame.message.phase == Phase::Settled;
        let settled: Vec<usize> = (0..frames.len()).filter(|idx| is_settled(&frames[*idx])).collect();
        let Some(&first) = settled.first() else { return };
        let cells = frames[first].message.cells_newtons.clone();
        let Some(cell) = (0..cells.len()).max_by(|a, b| cells[*a].total_cmp(&cells[*b])) else { return };
        let of_cell = |frame: &mut Stamped<TactileFrame>, value| {
            if let Some(reading) = frame.message.cells_newtons.get_mut(cell) {
                *reading = value;
            }
        };
        match self {
            InjectedFault::DropOuts => {
                let mut place = 0;
                frames.retain(|_frame| {
                    place += 1;
                    place % 3 != 0
                });
            }
            InjectedFault::DoubledFrame => frames.insert(first + 1, frames[first].clone()),
            InjectedFault::DeadCell => frames.iter_mut().for_each(|frame| of_cell(frame, 0.0)),
            InjectedFault::StuckCell => frames.iter_mut().for_each(|frame| of_cell(frame, cells[cell])),
            InjectedFault::DeadPad => {
                let mut loads: BTreeMap<usize, f64> = BTreeMap::new();
                for (newtons, pad) in cells.iter().zip(pad_of_cell) {
                    *loads.entry(*pad).or_default() += newtons;
                }
                let most = loads.into_iter().max_by(|(_, a), (_, b)| a.total_cmp(b)).map(|(pad, _)| pad);
                for frame in frames {
                    let readings = frame.message.cells_newtons.iter_mut().zip(pad_of_cell);
                    readings.filter(|(_, pad)| Some(**pad) == most).for_each(|(reading, _)| *reading = 0.0);
                }
            }
            InjectedFault::LostFrame
            | InjectedFault::LateFrame
            | InjectedFault::SilentFrame
            | InjectedFault::NanReading => {
                let Some(&second) = settled.get(1) else { return };
                match self {
                    InjectedFault::LostFrame => drop(frames.remove(second)),
                    InjectedFault::LateFrame => frames.swap(first, second),
                    InjectedFault::SilentFrame => frames[second].message.cells_newtons.fill(0.0),
                    _ => of_cell(&mut frames[second], f64::NAN),
                }
            }
        }
    }
}

/// Writes the frames and labels of `recording` to `out`, each grasp with the fault.
///
/// # Errors
/// The recording cannot be read, or `out` cannot be written.
pub fn write_with_fault(
    recording: &Path,
    topic: &str,
    fault: InjectedFault,
    pad_of_cell: &[usize],
    out: &Path,
) -> Result<(), RecordingError> {
    let reader = RecordingReader::open(recording)?;
    let mut writer = RecordingWriter::create(out, reader.info())?;
    let mut grasp: Vec<Stamped<TactileFrame>> = Vec::new();
    let flush = |grasp: &mut Vec<Stamped<TactileFrame>>, writer: &mut RecordingWriter| {
        fault.apply(grasp, pad_of_cell);
        grasp.drain(..).try_for_each(|frame| writer.write(topic, &frame))
    };
    for record in reader {
        let (of, record) = record?;
        match record {
            Record::Tactile(frame) if of == topic => {
                let of_grasp = |frame: &Stamped<TactileFrame>| (frame.header.epoch, frame.message.grasp_id);
                if grasp.last().is_some_and(|last| of_grasp(last) != of_grasp(&frame)) {
                    flush(&mut grasp, &mut writer)?;
                }
                grasp.push(frame);
            }
            Record::Truth(truth) => writer.write(&of, &truth)?,
            _ => {}
        }
    }
    flush(&mut grasp, &mut writer)?;
    writer.finish().map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;
    use blindgrasp_messages::Header;

    fn grasp() -> Vec<Stamped<TactileFrame>> {
        let phases = [Phase::Open, Phase::Closing, Phase::Settled, Phase::Settled, Phase::Settled, Phase::Ended];
        let frame = |(seq, phase)| Stamped {
            header: Header { seq, ..Header::default() },
            message: TactileFrame { phase, cells_newtons: vec![1.0, 3.0, 0.0, 3.5], ..TactileFrame::default() },
        };
        (0..).zip(phases).map(frame).collect()
    }

    /// The numbers of the frames, and the readings of the second settled one of them.
    fn after(fault: InjectedFault) -> (Vec<u64>, Vec<f64>) {
        let mut frames = grasp();
        fault.apply(&mut frames, &[0, 0, 1, 1]);
        let settled = frames.iter().filter(|frame| frame.message.phase == Phase::Settled);
        let readings = settled.skip(1).map(|frame| frame.message.cells_newtons.clone()).next();
        (frames.iter().map(|frame| frame.header.seq).collect(), readings.unwrap_or_default())
    }

    #[test]
    fn each_fault_by_hand() {
        let (all, readings) = (vec![0, 1, 2, 3, 4, 5], vec![1.0, 3.0, 0.0, 3.5]);
        for (fault, seqs, expected) in [
            (InjectedFault::LostFrame, vec![0, 1, 2, 4, 5], readings.clone()),
            (InjectedFault::DropOuts, vec![0, 1, 3, 4], readings.clone()),
            (InjectedFault::DoubledFrame, vec![0, 1, 2, 2, 3, 4, 5], readings.clone()),
            (InjectedFault::LateFrame, vec![0, 1, 3, 2, 4, 5], readings.clone()),
            (InjectedFault::SilentFrame, all.clone(), vec![0.0; 4]),
            (InjectedFault::DeadCell, all.clone(), vec![1.0, 3.0, 0.0, 0.0]),
            (InjectedFault::StuckCell, all.clone(), readings.clone()),
            // Its two cells have 4 N together, the other pad's have 3.5 N.
            (InjectedFault::DeadPad, all.clone(), vec![0.0, 0.0, 0.0, 3.5]),
        ] {
            assert_eq!(after(fault), (seqs, expected), "{fault:?}");
        }
        let (seqs, missing) = after(InjectedFault::NanReading);
        assert!(seqs == all && missing[3].is_nan() && missing[..3] == readings[..3]);
    }

    #[test]
    fn a_grasp_that_never_settles_stays_as_it_is() {
        for (fault, _) in InjectedFault::ALL {
            let mut frames: Vec<_> = grasp().into_iter().take(2).collect();
            fault.apply(&mut frames, &[0, 0, 1, 1]);
            assert_eq!(frames.len(), 2, "{fault:?}");
            fault.apply(&mut Vec::new(), &[]);
        }
    }
}
