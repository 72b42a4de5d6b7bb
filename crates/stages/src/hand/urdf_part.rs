//! Changes to the text of a URDF: the part of a whole robot that is the hand, and other names for its meshes. All else stays
//! as it is. Nothing is read but the names of links, joints and meshes, so a fault elsewhere does not matter.

use std::collections::{BTreeMap, BTreeSet};

use quick_xml::Reader;
use quick_xml::escape::escape;
use quick_xml::events::{BytesStart, Event};

use super::urdf_xml::Attributes;

/// The URDF of the link `base` and of the links below it, with the joints between them. The text of these, and of elements that
/// are neither link nor joint, stays as it is.
///
/// # Errors
/// The text is no XML, or it has no such link.
pub fn part_below(urdf: &str, base: &str) -> Result<String, String> {
    let skeleton = Skeleton::of(urdf)?;
    if !skeleton.links.iter().any(|link| link == base) {
        return Err(format!("the URDF has no link '{base}' (it has {})", skeleton.links.join(", ")));
    }
    let mut children: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for joint in skeleton.joints.values() {
        children.entry(&joint.parent).or_default().push(&joint.child);
    }
    let (mut kept, mut pending) = (BTreeSet::new(), vec![base]);
    while let Some(link) = pending.pop() {
        if kept.insert(link) {
            pending.extend(children.get(link).into_iter().flatten());
        }
    }
    let mut cut_from = None;
    edited(urdf, |event, path, text| {
        let [_, element] = path else { return Ok(None) };
        let name = |start: &BytesStart<'_>| Attributes::of(start)?.required("name");
        let is_cut = |start: &BytesStart<'_>| -> Result<bool, String> {
            Ok(match element.as_str() {
                "link" => !kept.contains(name(start)?.as_str()),
                "joint" => {
                    let joint = skeleton.joints.get(&name(start)?);
                    !joint.is_some_and(|joint| kept.contains(joint.parent.as_str()))
                }
                _ => false,
            })
        };
        Ok(match event {
            Event::Start(start) if is_cut(start)? => {
                cut_from = Some(text.0);
                None
            }
            Event::Empty(start) if is_cut(start)? => Some((text, String::new())),
            Event::End(_) => cut_from.take().map(|from| ((from, text.1), String::new())),
            _ => None,
        })
    })
}

/// The URDF with other names for the files of its collision meshes, where `renamed` gives one.
///
/// # Errors
/// The text is no XML, or `renamed` fails.
pub fn with_meshes_renamed(
    urdf: &str,
    mut renamed: impl FnMut(&str) -> Result<Option<String>, String>,
) -> Result<String, String> {
    edited(urdf, |event, path, text| {
        let (Event::Start(start) | Event::Empty(start)) = event else { return Ok(None) };
        let is_mesh = path.len() == 5 && path[1..] == ["link", "collision", "geometry", "mesh"];
        if !is_mesh {
            return Ok(None);
        }
        let attributes = Attributes::of(start)?;
        let Some(name) = renamed(&attributes.required("filename")?)? else { return Ok(None) };
        let of_mesh: String = attributes
            .iter()
            .map(|(key, value)| {
                let value = if key == "filename" { name.as_str() } else { value };
                format!(" {key}=\"{}\"", escape(value))
            })
            .collect();
        let end = if matches!(event, Event::Empty(_)) { "/" } else { "" };
        Ok(Some((text, format!("<mesh{of_mesh}{end}>"))))
    })
}

/// The places of a text, in bytes, between which something is put.
type Span = (usize, usize);

/// The text with some parts replaced by `edit`, which is given each event, the names of the open elements including that of the
/// event, and the event's place.
fn edited(
    text: &str,
    mut edit: impl FnMut(&Event<'_>, &[String], Span) -> Result<Option<(Span, String)>, String>,
) -> Result<String, String> {
    let (mut written, mut copied, mut path) = (String::new(), 0, Vec::new());
    let mut reader = Reader::from_str(text);
    loop {
        let from = reader.buffer_position() as usize;
        let event = reader.read_event().map_err(|error| format!("not a URDF, or cut off: {error}"))?;
        let span = (from, reader.buffer_position() as usize);
        if let Event::Start(start) | Event::Empty(start) = &event {
            path.push(start.name().as_ref().to_owned());
        }
        if let Some(((from, to), by)) = edit(&event, &path, span)? {
            written += &text[copied..from];
            written += &by;
            copied = to;
        }
        match event {
            Event::End(_) | Event::Empty(_) => drop(path.pop()),
            Event::Eof => return Ok(written + &text[copied..]),
            _ => {}
        }
    }
}

/// The names of the links, and how joints join them.
#[derive(Default)]
struct Skeleton {
    links: Vec<String>,
    joints: BTreeMap<String, Ends>,
}

/// The links that a joint joins; empty where none is named.
#[derive(Default)]
struct Ends {
    parent: String,
    child: String,
}

impl Skeleton {
    fn of(urdf: &str) -> Result<Skeleton, String> {
        let mut skeleton = Skeleton::default();
        let mut joint = String::new();
        edited(urdf, |event, path, _| {
            let (Event::Start(start) | Event::Empty(start)) = event else { return Ok(None) };
            let path: Vec<&str> = path.iter().skip(1).map(String::as_str).collect();
            match path[..] {
                ["link"] => skeleton.links.push(Attributes::of(start)?.required("name")?),
                ["joint"] => joint = Attributes::of(start)?.required("name")?,
                ["joint", end @ ("parent" | "child")] => {
                    let ends = skeleton.joints.entry(joint.clone()).or_default();
                    let link = if end == "parent" { &mut ends.parent } else { &mut ends.child };
                    if link.is_empty() {
                        *link = Attributes::of(start)?.required("link")?;
                    }
                }
                _ => {}
            }
            Ok(None)
        })?;
        Ok(skeleton)
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
        let faulty = whole.replace("<visual/>", "<collision><geometry><a:b/><box size='1 x'/></geometry></collision>");
        assert_eq!(part_below(&faulty, "palm").expect("a part"), part);
        assert_eq!(
            part_below(&whole, "thumb").expect_err("unknown"),
            "the URDF has no link 'thumb' (it has world, arm, palm, finger)"
        );
    }

    #[test]
    fn collision_meshes_are_renamed_however_they_are_written() {
        let of = |tip: &str, nail: &str| {
            format!(
                "<robot><link name='a'><visual><geometry><mesh filename='v.stl'/></geometry></visual>\
                 <collision><geometry>{tip}</geometry></collision><collision/><!-- <mesh filename='c.stl'/> -->\
                 <collision><geometry>{nail}</geometry></collision></link></robot>"
            )
        };
        let urdf =
            of("<mesh\n  filename = 'tip &amp; \"pad\".stl' scale='1 1 1'/>", "<mesh filename=\"nail.stl\"></mesh>");
        let mut seen = Vec::new();
        let renamed = with_meshes_renamed(&urdf, |name| {
            seen.push(name.to_owned());
            Ok((name != "nail.stl").then(|| format!("meshes/{name}")))
        });
        let tip = "<mesh filename=\"meshes/tip &amp; &quot;pad&quot;.stl\" scale=\"1 1 1\"/>";
        assert_eq!(renamed.expect("renamed"), of(tip, "<mesh filename=\"nail.stl\"></mesh>"));
        assert_eq!(seen, ["tip & \"pad\".stl", "nail.stl"]);
    }
}
