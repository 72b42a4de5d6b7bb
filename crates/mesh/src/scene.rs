//! Files that hold a scene of meshes: COLLADA (.dae) and binary glTF (.glb). Their meshes become one, as the scene places them.

use std::collections::HashMap;

use nalgebra::{Matrix4, Point3, Rotation3, Unit, Vector3};
use quick_xml::Reader;
use quick_xml::escape::unescape;
use quick_xml::events::{BytesStart, Event};
use serde_json::Value;

use crate::read::{Problem, Soup, quoted};

/// Most places of meshes in a scene, and most vertices of all of them: a scene may name a mesh as often as it likes.
const MAX_PLACES: usize = 10_000;
const MAX_VERTICES: usize = 20_000_000;
const MAX_CORNERS: usize = 60_000_000;

/// A surface: vertices, and polygons as indices into them.
struct Surface {
    vertices: Vec<[f64; 3]>,
    polygons: Vec<Vec<i64>>,
}

impl Surface {
    fn place(&self, soup: &mut Soup, scene_from_mesh: &Matrix4<f64>) -> Result<(), Problem> {
        let first = soup.n_vertices() as i64;
        let n_corners: usize = self.polygons.iter().map(Vec::len).sum();
        if soup.n_vertices() + self.vertices.len() > MAX_VERTICES || soup.n_corners() + n_corners > MAX_CORNERS {
            return Err(Problem::new(None, format!("at most {MAX_VERTICES} vertices, {MAX_CORNERS} corners"), "more"));
        }
        for vertex in &self.vertices {
            let placed = scene_from_mesh.transform_point(&Point3::from(*vertex));
            soup.push_vertex([placed.x, placed.y, placed.z], None);
        }
        for polygon in &self.polygons {
            if polygon.iter().any(|idx| !(0..self.vertices.len() as i64).contains(idx)) {
                return Err(Problem::new(
                    None,
                    format!("indices below {}", self.vertices.len()),
                    format!("{polygon:?}"),
                ));
            }
            let placed: Vec<i64> = polygon.iter().map(|idx| first + idx).collect();
            soup.push_polygon(&placed, None)?;
        }
        Ok(())
    }
}

fn missing(what: &str, found: impl Into<String>) -> Problem {
    Problem::new(None, what, found)
}

/// Reads the triangles and polygons of a COLLADA file's scene, in metres by its `<unit>`. Its `<up_axis>` says nothing: loaders of
/// ROS (RViz, geometric_shapes) ignore it, and packages have the same part as STL and as COLLADA with +y up in the same axes. Without a
/// scene, each geometry stands where it was made.
///
/// # Errors
/// A damaged file, or one without such geometries.
pub(crate) fn parse_dae(bytes: &[u8]) -> Result<Soup, Problem> {
    let root = Element::read(&String::from_utf8_lossy(bytes))?;
    let elements = root.all();
    let ids = elements.iter().map(|element| (element.attribute("id"), *element)).filter(|(id, _)| !id.is_empty());
    let mut dae = Dae { root: &root, ids: ids.collect(), soup: Soup::default(), n_places: 0 };
    let to_metres = dae.root_transform()?;
    let scene = root.child("scene").and_then(|scene| scene.child("instance_visual_scene"));
    let named = scene.and_then(|scene| dae.named(scene.attribute("url")).ok());
    let first = || elements.iter().find(|element| element.name == "visual_scene").copied();
    let nodes = named.or_else(first).into_iter().flat_map(|scene| &scene.children);
    let mut pending: Vec<(&Element, Matrix4<f64>)> =
        nodes.filter(|child| child.name == "node").map(|node| (node, to_metres)).collect();
    if pending.is_empty() {
        for geometry in elements.iter().filter(|element| element.name == "geometry") {
            dae.place(geometry, &to_metres)?;
        }
    }
    while let Some((node, scene_from_parent)) = pending.pop() {
        dae.count_place()?;
        let scene_from_node = scene_from_parent * transform_of(node)?;
        for child in &node.children {
            match child.name.as_str() {
                "node" => pending.push((child, scene_from_node)),
                "instance_node" => pending.push((dae.named(child.attribute("url"))?, scene_from_node)),
                "instance_geometry" => dae.place(dae.named(child.attribute("url"))?, &scene_from_node)?,
                "instance_controller" => {
                    let controller = dae.named(child.attribute("url"))?;
                    let skin = controller.child("skin").ok_or_else(|| missing("a controller with a <skin>", "none"))?;
                    dae.place(dae.named(skin.attribute("source"))?, &scene_from_node)?;
                }
                _ => {}
            }
        }
    }
    Ok(dae.soup)
}

/// An XML element with its text and the elements in it.
#[derive(Default)]
struct Element {
    name: String,
    attributes: HashMap<String, String>,
    text: String,
    children: Vec<Element>,
}

impl Element {
    fn begun(start: &BytesStart<'_>) -> Element {
        let mut element = Element { name: start.local_name().as_ref().to_owned(), ..Element::default() };
        for attribute in start.attributes().with_checks(false).flatten() {
            let value = unescape(&attribute.value).unwrap_or_default().into_owned();
            element.attributes.insert(attribute.key.as_ref().to_owned(), value);
        }
        element
    }

    fn attribute(&self, name: &str) -> &str {
        self.attributes.get(name).map_or("", String::as_str)
    }

    fn child(&self, name: &str) -> Option<&Element> {
        self.children.iter().find(|child| child.name == name)
    }

    fn inputs(&self, semantic: &str) -> impl Iterator<Item = &Element> {
        self.children.iter().filter(move |child| child.name == "input" && child.attribute("semantic") == semantic)
    }

    fn numbers<T: std::str::FromStr>(&self) -> Result<Vec<T>, Problem> {
        let number =
            |word: &str| word.parse().map_err(|_| missing(&format!("numbers in <{}>", self.name), quoted(word)));
        self.text.split_whitespace().map(number).collect()
    }

    fn exactly<const N: usize>(&self) -> Result<[f64; N], Problem> {
        let numbers: Vec<f64> = self.numbers()?;
        let n_found = numbers.len();
        numbers.try_into().map_err(|_| missing(&format!("{N} numbers in <{}>", self.name), n_found.to_string()))
    }
}

impl Element {
    /// The root of a COLLADA file.
    fn read(text: &str) -> Result<Element, Problem> {
        const MAX_DEPTH: usize = 256;
        let mut reader = Reader::from_str(text);
        let mut open: Vec<Element> = Vec::new();
        loop {
            let event = reader.read_event();
            let line =
                || 1 + text.as_bytes()[..reader.buffer_position() as usize].iter().filter(|b| **b == b'\n').count();
            let closed = match event {
                Ok(Event::Start(start)) if open.len() < MAX_DEPTH => {
                    open.push(Element::begun(&start));
                    None
                }
                Ok(Event::Start(_)) => {
                    return Err(Problem::new(Some(line()), "elements nested at most 256 deep", "more"));
                }
                Ok(Event::Empty(start)) => Some(Element::begun(&start)),
                Ok(Event::End(_)) => open.pop(),
                Ok(Event::Text(text)) => {
                    open.iter_mut().last().into_iter().for_each(|element| element.text.push_str(&text));
                    None
                }
                Ok(Event::Eof) => return Err(Problem::cut_off(Some(line()), "XML with one <COLLADA>")),
                Ok(_) => None,
                Err(quick_xml::Error::Syntax(_)) => {
                    return Err(Problem::cut_off(Some(line()), "XML with one <COLLADA>"));
                }
                Err(error) => return Err(Problem::new(Some(line()), "XML with one <COLLADA>", error.to_string())),
            };
            match (closed, open.last_mut()) {
                (Some(element), Some(parent)) => parent.children.push(element),
                (Some(root), None) if root.name == "COLLADA" => return Ok(root),
                (Some(other), None) => {
                    return Err(Problem::new(Some(line()), "XML with one <COLLADA>", format!("<{}>", other.name)));
                }
                (None, _) => {}
            }
        }
    }

    /// It and all elements in it, in the file's order.
    fn all(&self) -> Vec<&Element> {
        let (mut found, mut pending) = (Vec::new(), vec![self]);
        while let Some(element) = pending.pop() {
            found.push(element);
            pending.extend(element.children.iter().rev());
        }
        found
    }
}

/// A COLLADA file as it is read.
struct Dae<'a> {
    root: &'a Element,
    ids: HashMap<&'a str, &'a Element>,
    soup: Soup,
    /// Nodes and surfaces so far.
    n_places: usize,
}

impl<'a> Dae<'a> {
    fn count_place(&mut self) -> Result<(), Problem> {
        self.n_places += 1;
        if self.n_places > MAX_PLACES {
            return Err(missing("a scene of at most 10,000 nodes and surfaces", "more, or nodes that name each other"));
        }
        Ok(())
    }

    /// The element that a URL (`#ID`) names.
    fn named(&self, url: &str) -> Result<&'a Element, Problem> {
        let id = url.strip_prefix('#').unwrap_or(url);
        self.ids.get(id).copied().ok_or_else(|| missing("the id of an element of the file", quoted(url)))
    }

    /// To metres.
    fn root_transform(&self) -> Result<Matrix4<f64>, Problem> {
        let asset = self.root.child("asset");
        let unit = asset.and_then(|asset| asset.child("unit")).map_or("", |unit| unit.attribute("meter"));
        let metres: f64 = if unit.is_empty() { 1.0 } else { unit.parse().unwrap_or(f64::NAN) };
        if !(metres.is_finite() && metres > 0.0) {
            return Err(missing("<unit meter> of more than 0", quoted(unit)));
        }
        Ok(Matrix4::new_scaling(metres))
    }

    fn place(&mut self, geometry: &Element, scene_from_mesh: &Matrix4<f64>) -> Result<(), Problem> {
        let Some(mesh) = geometry.child("mesh") else { return self.count_place() };
        for primitive in &mesh.children {
            let is_surface =
                matches!(primitive.name.as_str(), "triangles" | "polylist" | "polygons" | "tristrips" | "trifans");
            if let Some(input) = primitive.inputs("VERTEX").next()
                && is_surface
            {
                self.count_place()?;
                let vertices = self.positions(input)?;
                let polygons = polygons(primitive, input)?;
                Surface { vertices, polygons }.place(&mut self.soup, scene_from_mesh)?;
            }
        }
        Ok(())
    }

    /// The positions that the input of a primitive names.
    fn positions(&self, input: &Element) -> Result<Vec<[f64; 3]>, Problem> {
        let vertices = self.named(input.attribute("source"))?;
        let position =
            vertices.inputs("POSITION").next().ok_or_else(|| missing("<vertices> with a POSITION", "none"))?;
        let source = self.named(position.attribute("source"))?;
        let accessor = source.child("technique_common").and_then(|common| common.child("accessor"));
        let number = |name: &str, default: usize| {
            accessor.and_then(|accessor| accessor.attribute(name).parse().ok()).unwrap_or(default)
        };
        let (stride, offset) = (number("stride", 3), number("offset", 0));
        let array = source.child("float_array").ok_or_else(|| missing("positions in a <float_array>", "none"))?;
        let numbers: Vec<f64> = array.numbers()?;
        if stride < 3 {
            return Err(missing("positions of 3 numbers", format!("a stride of {stride}")));
        }
        let of_vertices = numbers.get(offset..).unwrap_or_default().chunks(stride).filter(|chunk| chunk.len() >= 3);
        Ok(of_vertices.map(|chunk| [chunk[0], chunk[1], chunk[2]]).collect())
    }
}

/// The polygons of a primitive, as indices of its vertices.
fn polygons(primitive: &Element, vertex: &Element) -> Result<Vec<Vec<i64>>, Problem> {
    // No file has more inputs beside each other.
    let offset_of = |input: &Element| match input.attribute("offset") {
        "" => Ok(0),
        offset => offset.parse::<u8>().map(usize::from).map_err(|_| missing("an offset below 256", quoted(offset))),
    };
    let inputs = primitive.children.iter().filter(|child| child.name == "input");
    let offsets = inputs.map(offset_of).collect::<Result<Vec<_>, _>>()?;
    let stride = offsets.iter().max().map_or(1, |last| last + 1);
    let offset = offset_of(vertex)?;
    let of_vertices = |list: &Element| -> Result<Vec<i64>, Problem> {
        Ok(list.numbers::<i64>()?.into_iter().skip(offset).step_by(stride).collect())
    };
    let lists = primitive.children.iter().filter(|child| child.name == "p" || child.name == "ph");
    let lists = lists.map(|list| of_vertices(list.child("p").unwrap_or(list))).collect::<Result<Vec<_>, _>>()?;
    let rows = || lists.iter().filter(|list| list.len() >= 3);
    Ok(match primitive.name.as_str() {
        "polylist" => {
            let counts: Vec<usize> = primitive.child("vcount").map(Element::numbers).transpose()?.unwrap_or_default();
            let mut rest = lists.first().map_or(&[][..], Vec::as_slice);
            let mut polygons = Vec::new();
            for count in counts {
                let Some((polygon, after)) = rest.split_at_checked(count) else {
                    return Err(missing("as many indices as <vcount> says", "fewer"));
                };
                rest = after;
                // Loose points and lines have no area.
                polygons.extend((count >= 3).then(|| polygon.to_vec()));
            }
            polygons
        }
        "triangles" => rows().flat_map(|list| list.chunks_exact(3).map(<[i64]>::to_vec)).collect(),
        "tristrips" => rows().flat_map(|list| strip(list)).collect(),
        _ => rows().cloned().collect(),
    })
}

/// The triangles of a strip: every other one turns the other way.
fn strip(idxs: &[i64]) -> Vec<Vec<i64>> {
    let turned = |(n, window): (usize, &[i64])| match n % 2 {
        0 => window.to_vec(),
        _ => vec![window[1], window[0], window[2]],
    };
    idxs.windows(3).enumerate().map(turned).collect()
}

/// The product of a node's transforms, in the order of the file.
fn transform_of(node: &Element) -> Result<Matrix4<f64>, Problem> {
    let mut product = Matrix4::identity();
    for child in &node.children {
        product *= match child.name.as_str() {
            "matrix" => Matrix4::from_row_slice(&child.exactly::<16>()?),
            "translate" => Matrix4::new_translation(&Vector3::from(child.exactly::<3>()?)),
            "scale" => Matrix4::new_nonuniform_scaling(&Vector3::from(child.exactly::<3>()?)),
            "rotate" => {
                let [x, y, z, degrees] = child.exactly::<4>()?;
                let axis = Unit::try_new(Vector3::new(x, y, z), 1e-12).unwrap_or_else(Vector3::x_axis);
                Rotation3::from_axis_angle(&axis, degrees.to_radians()).to_homogeneous()
            }
            _ => continue,
        };
    }
    Ok(product)
}

/// Reads the triangles of a binary glTF file's scene, in its own axes.
///
/// # Errors
/// A damaged file, one whose numbers are in other files or are compressed, or one without triangles.
pub(crate) fn parse_glb(bytes: &[u8]) -> Result<Soup, Problem> {
    let glb = Glb::read(bytes)?;
    let mut soup = Soup::default();
    let scene = glb.json["scene"].as_u64().unwrap_or(0) as usize;
    let roots = glb.json["scenes"][scene]["nodes"].as_array().cloned().unwrap_or_default();
    let mut pending: Vec<(Value, Matrix4<f64>)> = roots.into_iter().map(|node| (node, Matrix4::identity())).collect();
    let mut n_places = 0;
    while let Some((idx, scene_from_parent)) = pending.pop() {
        n_places += 1;
        if n_places > MAX_PLACES {
            return Err(missing("a scene of at most 10,000 nodes", "more, or nodes that name each other"));
        }
        let node = &glb.json["nodes"][idx.as_u64().unwrap_or(u64::MAX) as usize];
        let scene_from_node = scene_from_parent * node_transform(node);
        if let Some(mesh) = node["mesh"].as_u64() {
            for primitive in glb.json["meshes"][mesh as usize]["primitives"].as_array().into_iter().flatten() {
                n_places += 1;
                if let Some(surface) = glb.surface(primitive)? {
                    surface.place(&mut soup, &scene_from_node)?;
                }
            }
        }
        let children = node["children"].as_array().into_iter().flatten();
        pending.extend(children.map(|child| (child.clone(), scene_from_node)));
    }
    Ok(soup)
}

fn node_transform(node: &Value) -> Matrix4<f64> {
    let numbers = |key: &str| -> Vec<f64> {
        node[key].as_array().into_iter().flatten().map(|number| number.as_f64().unwrap_or(f64::NAN)).collect()
    };
    let matrix = numbers("matrix");
    if matrix.len() == 16 {
        return Matrix4::from_column_slice(&matrix);
    }
    let vector = |key: &str, default: f64| match numbers(key)[..] {
        [x, y, z] => Vector3::new(x, y, z),
        _ => Vector3::repeat(default),
    };
    let rotation = match numbers("rotation")[..] {
        [x, y, z, w] => nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z)),
        _ => nalgebra::UnitQuaternion::identity(),
    };
    Matrix4::new_translation(&vector("translation", 0.0))
        * rotation.to_homogeneous()
        * Matrix4::new_nonuniform_scaling(&vector("scale", 1.0))
}

struct Glb<'a> {
    json: Value,
    binary: &'a [u8],
}

impl<'a> Glb<'a> {
    fn read(bytes: &'a [u8]) -> Result<Glb<'a>, Problem> {
        let word = |bytes: &[u8], at: usize| -> Option<u32> {
            Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
        };
        if !bytes.starts_with(b"glTF") || word(bytes, 4) != Some(2) {
            return Err(missing("a binary glTF file of version 2", "another file"));
        }
        let (mut json, mut binary, mut at) = (None, &[][..], 12);
        while let (Some(length), Some(kind)) = (word(bytes, at), word(bytes, at + 4)) {
            let content = bytes.get(at + 8..).and_then(|rest| rest.get(..length as usize));
            let content = content.ok_or_else(|| Problem::cut_off(None, format!("a part of {length} bytes")))?;
            match &kind.to_le_bytes() {
                b"JSON" => {
                    json = Some(serde_json::from_slice(content).map_err(|error| missing("JSON", error.to_string()))?)
                }
                b"BIN\0" => binary = content,
                _ => {}
            }
            at += 8 + length as usize;
        }
        let json = json.ok_or_else(|| Problem::cut_off(None, "a part of JSON"))?;
        Ok(Glb { json, binary })
    }

    /// `None` for points and lines.
    fn surface(&self, primitive: &Value) -> Result<Option<Surface>, Problem> {
        let mode = primitive["mode"].as_u64().unwrap_or(4);
        let position = primitive["attributes"]["POSITION"].as_u64();
        let (Some(position), 4..=6) = (position, mode) else { return Ok(None) };
        let rows = self.rows(position, 3)?;
        let vertices: Vec<[f64; 3]> = rows.iter().map(|row| [row[0], row[1], row[2]]).collect();
        let idxs: Vec<i64> = match primitive["indices"].as_u64() {
            Some(accessor) => self.rows(accessor, 1)?.into_iter().map(|row| row[0] as i64).collect(),
            None => (0..vertices.len() as i64).collect(),
        };
        let polygons = match mode {
            4 => idxs.chunks_exact(3).map(<[i64]>::to_vec).collect(),
            5 => strip(&idxs),
            _ => vec![idxs].into_iter().filter(|fan| fan.len() >= 3).collect(),
        };
        Ok(Some(Surface { vertices, polygons }))
    }

    /// The rows of numbers that an accessor names.
    fn rows(&self, accessor: u64, n_columns: usize) -> Result<Vec<Vec<f64>>, Problem> {
        let accessor = &self.json["accessors"][accessor as usize];
        let size = match accessor["componentType"].as_u64() {
            Some(5121) => 1,
            Some(5123) => 2,
            Some(5125 | 5126) => 4,
            other => return Err(missing("numbers of type 5121, 5123, 5125 or 5126", format!("{other:?}"))),
        };
        let is_float = accessor["componentType"] == 5126;
        let view = &self.json["bufferViews"][accessor["bufferView"].as_u64().unwrap_or(u64::MAX) as usize];
        let buffer = &self.json["buffers"][view["buffer"].as_u64().unwrap_or(u64::MAX) as usize];
        let is_other = accessor["normalized"] == true || accessor.get("sparse").is_some();
        if is_other || !view.is_object() || !buffer.is_object() || buffer.get("uri").is_some() {
            return Err(missing("plain numbers in the file itself, without compression", "others"));
        }
        let number = |value: &Value, default: usize| value.as_u64().map_or(default, |number| number as usize);
        let begin = number(&view["byteOffset"], 0).saturating_add(number(&accessor["byteOffset"], 0));
        let stride = match number(&view["byteStride"], 0) {
            0 => size * n_columns,
            stride if stride >= size * n_columns => stride,
            stride => return Err(missing("a stride of at least a row", stride.to_string())),
        };
        (0..number(&accessor["count"], 0))
            .map(|row| {
                let at = begin.saturating_add(row.saturating_mul(stride));
                let bytes = self.binary.get(at..).and_then(|rest| rest.get(..size * n_columns));
                let bytes = bytes.ok_or_else(|| Problem::cut_off(None, "as many numbers as an accessor says"))?;
                Ok(bytes.chunks_exact(size).map(|number| decoded(number, is_float)).collect())
            })
            .collect()
    }
}

fn decoded(bytes: &[u8], is_float: bool) -> f64 {
    match *bytes {
        [byte] => f64::from(byte),
        [a, b] => f64::from(u16::from_le_bytes([a, b])),
        [a, b, c, d] if is_float => f64::from(f32::from_le_bytes([a, b, c, d])),
        [a, b, c, d] => f64::from(u32::from_le_bytes([a, b, c, d])),
        _ => f64::NAN,
    }
}
