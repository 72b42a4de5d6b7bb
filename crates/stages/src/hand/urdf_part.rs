//! The hand in the URDF of a whole robot: a link with all links that hang on it.

use std::collections::{BTreeMap, BTreeSet};

use quick_xml::Reader;
use quick_xml::events::{BytesStart, Event};

use super::urdf_xml::{self, Attributes};

/// The URDF of the link `base` and of the links below it, with the joints between them. The text of these, and of elements that
/// are neither link nor joint, stays as it is.
///
/// # Errors
/// The text is no URDF, or it has no such link.
pub fn part_below(urdf: &str, base: &str) -> Result<String, String> {
    let robot = urdf_xml::read(urdf)?;
    if !robot.links.iter().any(|link| link.name == base) {
        let known: Vec<&str> = robot.links.iter().map(|link| link.name.as_str()).collect();
        return Err(format!("the URDF has no link '{base}' (it has {})", known.join(", ")));
    }
    let mut kept = BTreeSet::from([base]);
    let is_below = |joint: &&urdf_xml::Joint, kept: &BTreeSet<&str>| kept.contains(joint.parent.as_str());
    while let Some(joint) =
        robot.joints.iter().find(|joint| is_below(joint, &kept) && !kept.contains(joint.child.as_str()))
    {
        kept.insert(&joint.child);
    }
    let parents: BTreeMap<&str, &str> =
        robot.joints.iter().map(|joint| (joint.name.as_str(), joint.parent.as_str())).collect();
    let is_cut = |element: &BytesStart<'_>| -> Result<bool, String> {
        let name = || Attributes::of(element)?.required("name");
        Ok(match element.name().as_ref() {
            b"link" => !kept.contains(name()?.as_str()),
            b"joint" => !parents.get(name()?.as_str()).is_some_and(|parent| kept.contains(parent)),
            _ => false,
        })
    };
    let (mut part, mut copied, mut depth, mut cut_from) = (String::new(), 0, 0, None);
    let mut reader = Reader::from_str(urdf);
    loop {
        let from = reader.buffer_position() as usize;
        let event = reader.read_event().map_err(|error| error.to_string())?;
        let to = reader.buffer_position() as usize;
        match event {
            Event::Start(element) => {
                if depth == 1 && is_cut(&element)? {
                    cut_from = Some(from);
                }
                depth += 1;
            }
            Event::Empty(element) if depth == 1 && is_cut(&element)? => {
                part += &urdf[copied..from];
                copied = to;
            }
            Event::End(_) => {
                depth -= 1;
                if let Some(from) = cut_from.take_if(|_| depth == 1) {
                    part += &urdf[copied..from];
                    copied = to;
                }
            }
            Event::Eof => return Ok(part + &urdf[copied..]),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_part_below_a_link_is_a_urdf_of_its_own() {
        let joint = |name: &str, parent: &str, child: &str| {
            format!(
                "<joint name=\"{name}\" type=\"fixed\"><parent link=\"{parent}\"/><child link=\"{child}\"/></joint>\n"
            )
        };
        let hand = format!(
            "<link name=\"palm\"/>\n{}<link name=\"finger\"><collision/></link>\n",
            joint("knuckle", "palm", "finger")
        );
        let arm =
            format!("<link name=\"world\"/><link name=\"arm\"><visual/></link>{}", joint("shoulder", "world", "arm"));
        let wrist = joint("wrist", "arm", "palm");
        let whole = format!("<robot name=\"r\">{arm}{wrist}<!-- hand -->{hand}<material name=\"steel\"/></robot>");
        let part = part_below(&whole, "palm").expect("a part");
        assert_eq!(part, format!("<robot name=\"r\">\n\n<!-- hand -->{hand}<material name=\"steel\"/></robot>"));
        assert_eq!(part_below(&whole, "world").expect("all"), whole);
        assert_eq!(
            part_below(&whole, "thumb").expect_err("unknown"),
            "the URDF has no link 'thumb' (it has world, arm, palm, finger)"
        );
    }
}
