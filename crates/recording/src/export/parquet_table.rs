//! A topic as a Parquet file.

use std::io::Write;
use std::sync::Arc;

use parquet::basic::{Compression, ConvertedType, LogicalType, Repetition, Type as PhysicalType, ZstdLevel};
use parquet::data_type::{BoolType, ByteArray, ByteArrayType, DoubleType, Int32Type, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedColumnWriter, SerializedFileWriter};
use parquet::schema::types::{Type, TypePtr};

use super::row::{Row, Value};
use super::{ExportError, TableShape};

/// How much is gathered before it is written as a row group: what keeps memory constant, and large enough to compress
/// and scan well.
const ROW_GROUP_BYTES: usize = 16 << 20;

/// A Parquet file being written: lists and structs are nested columns, numbers are exact, NaN is kept.
pub struct ParquetTable<W: Write + Send> {
    writer: SerializedFileWriter<W>,
    exemplar: Row,
    columns: Vec<Column>,
    n_bytes: usize,
}

/// A leaf of the schema: what is gathered of the present row group.
///
/// Nothing is optional here, so that levels are simple. A value's definition level is how many lists it lies in; where a
/// list is empty, how many lists that one lies in. A repetition level is the depth of the list that the value goes on
/// with, 0 for a new row.
struct Column {
    values: Values,
    is_in_list: bool,
    definition_levels: Vec<i16>,
    repetition_levels: Vec<i16>,
}

enum Values {
    Bool(Vec<bool>),
    I32(Vec<i32>),
    I64(Vec<i64>),
    F64(Vec<f64>),
    Text(Vec<ByteArray>),
}

/// Where in a row a value lies.
#[derive(Clone, Copy)]
struct Place {
    /// In how many lists.
    depth: i16,
    /// The repetition level of the next value.
    repetition: i16,
}

impl<W: Write + Send> ParquetTable<W> {
    /// Begins a file.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn new(to: W, shape: &TableShape) -> Result<Self, ExportError> {
        let properties = WriterProperties::builder().set_compression(Compression::ZSTD(ZstdLevel::try_new(3)?)).build();
        let schema = group("samples", &shape.exemplar, None)?;
        let writer = SerializedFileWriter::new(to, Arc::new(schema), Arc::new(properties))?;
        let mut columns = Vec::new();
        shape.exemplar.iter().for_each(|(_, value)| add_columns(value, false, &mut columns));
        Ok(ParquetTable { writer, exemplar: shape.exemplar.clone(), columns, n_bytes: 0 })
    }

    /// Appends a sample.
    ///
    /// # Errors
    /// It cannot be written, or is not like those that the table was made for.
    pub fn write(&mut self, row: &Row) -> Result<(), ExportError> {
        let start = Place { depth: 0, repetition: 0 };
        let columns = &mut self.columns[..];
        self.n_bytes += shred_fields(row, &self.exemplar, start, columns)?;
        if self.n_bytes >= ROW_GROUP_BYTES {
            self.write_row_group()?;
        }
        Ok(())
    }

    /// Completes the file.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn finish(mut self) -> Result<W, ExportError> {
        if self.n_bytes > 0 {
            self.write_row_group()?;
        }
        Ok(self.writer.into_inner()?)
    }

    fn write_row_group(&mut self) -> Result<(), ExportError> {
        let mut group = self.writer.next_row_group()?;
        for column in &mut self.columns {
            let Some(mut to) = group.next_column()? else { break };
            column.write(&mut to)?;
            to.close()?;
            column.clear();
        }
        group.close()?;
        self.n_bytes = 0;
        Ok(())
    }
}

impl Column {
    fn write(&self, to: &mut SerializedColumnWriter<'_>) -> Result<(), ParquetError> {
        let levels = |levels| self.is_in_list.then_some(levels);
        let (definition, repetition) = (levels(&self.definition_levels[..]), levels(&self.repetition_levels[..]));
        match &self.values {
            Values::Bool(values) => to.typed::<BoolType>().write_batch(values, definition, repetition)?,
            Values::I32(values) => to.typed::<Int32Type>().write_batch(values, definition, repetition)?,
            Values::I64(values) => to.typed::<Int64Type>().write_batch(values, definition, repetition)?,
            Values::F64(values) => to.typed::<DoubleType>().write_batch(values, definition, repetition)?,
            Values::Text(values) => to.typed::<ByteArrayType>().write_batch(values, definition, repetition)?,
        };
        Ok(())
    }

    fn clear(&mut self) {
        self.definition_levels.clear();
        self.repetition_levels.clear();
        match &mut self.values {
            Values::Bool(values) => values.clear(),
            Values::I32(values) => values.clear(),
            Values::I64(values) => values.clear(),
            Values::F64(values) => values.clear(),
            Values::Text(values) => values.clear(),
        }
    }

    fn push_levels(&mut self, place: Place) {
        self.definition_levels.push(place.depth);
        self.repetition_levels.push(place.repetition);
    }

    /// Returns how many bytes it has taken, about.
    fn push(&mut self, value: &Value, place: Place) -> Result<usize, ExportError> {
        match (&mut self.values, value) {
            (Values::Bool(values), Value::Bool(value)) => values.push(*value),
            (Values::I32(values), Value::I32(value)) => values.push(*value),
            // Parquet has unsigned numbers as an annotation of signed ones, bit by bit.
            (Values::I32(values), Value::U32(value)) => values.push(value.cast_signed()),
            (Values::I64(values), Value::I64(value)) => values.push(*value),
            (Values::I64(values), Value::U64(value)) => values.push(value.cast_signed()),
            (Values::F64(values), Value::F64(value)) => values.push(*value),
            (Values::Text(values), Value::Text(value)) => values.push(ByteArray::from(value.as_str())),
            (_, other) => return Err(unlike(other)),
        }
        self.push_levels(place);
        let n_text_bytes = if let Value::Text(text) = value { size_of::<ByteArray>() + text.len() } else { 8 };
        Ok(n_text_bytes + 2 * size_of::<i16>())
    }
}

fn unlike(value: &Value) -> ExportError {
    ExportError::Shape(format!("found {value:?}, which is not what the samples before it hold in its place"))
}

/// A group of the schema with one child per named value.
fn group(name: &str, fields: &[(&'static str, Value)], repetition: Option<Repetition>) -> Result<Type, ExportError> {
    let fields: Vec<TypePtr> =
        fields.iter().map(|(name, value)| Ok(Arc::new(node(name, value)?))).collect::<Result<_, ExportError>>()?;
    let builder = Type::group_type_builder(name).with_fields(fields);
    // The root has no repetition.
    Ok(match repetition {
        Some(repetition) => builder.with_repetition(repetition).build()?,
        None => builder.build()?,
    })
}

/// A required value of the schema, like this one.
fn node(name: &str, like: &Value) -> Result<Type, ExportError> {
    let primitive = |physical, logical: Option<LogicalType>| {
        let builder = Type::primitive_type_builder(name, physical).with_repetition(Repetition::REQUIRED);
        Ok(builder.with_logical_type(logical).build()?)
    };
    match like {
        Value::Bool(_) => primitive(PhysicalType::BOOLEAN, None),
        Value::I32(_) => primitive(PhysicalType::INT32, None),
        Value::I64(_) => primitive(PhysicalType::INT64, None),
        Value::U32(_) => primitive(PhysicalType::INT32, Some(LogicalType::integer(32, false))),
        Value::U64(_) => primitive(PhysicalType::INT64, Some(LogicalType::integer(64, false))),
        Value::F64(_) => primitive(PhysicalType::DOUBLE, None),
        Value::Text(_) => primitive(PhysicalType::BYTE_ARRAY, Some(LogicalType::String)),
        Value::Struct(fields) => group(name, fields, Some(Repetition::REQUIRED)),
        Value::List(items) => {
            let item = items.first().ok_or_else(|| unlike(like))?;
            // The three levels that the format prescribes.
            let list = Type::group_type_builder("list")
                .with_repetition(Repetition::REPEATED)
                .with_fields(vec![Arc::new(node("element", item)?)])
                .build()?;
            Ok(Type::group_type_builder(name)
                .with_repetition(Repetition::REQUIRED)
                .with_logical_type(Some(LogicalType::List))
                .with_converted_type(ConvertedType::LIST)
                .with_fields(vec![Arc::new(list)])
                .build()?)
        }
    }
}

/// The leaves of a value of the schema, in its order.
fn add_columns(like: &Value, is_in_list: bool, columns: &mut Vec<Column>) {
    let values = match like {
        Value::Bool(_) => Values::Bool(Vec::new()),
        Value::I32(_) | Value::U32(_) => Values::I32(Vec::new()),
        Value::I64(_) | Value::U64(_) => Values::I64(Vec::new()),
        Value::F64(_) => Values::F64(Vec::new()),
        Value::Text(_) => Values::Text(Vec::new()),
        Value::List(items) => return items.iter().take(1).for_each(|item| add_columns(item, true, columns)),
        Value::Struct(fields) => return fields.iter().for_each(|(_, of)| add_columns(of, is_in_list, columns)),
    };
    columns.push(Column { values, is_in_list, definition_levels: Vec::new(), repetition_levels: Vec::new() });
}

fn n_leaves(like: &Value) -> usize {
    match like {
        Value::List(items) => items.first().map_or(0, n_leaves),
        Value::Struct(fields) => fields.iter().map(|(_, of)| n_leaves(of)).sum(),
        _ => 1,
    }
}

/// Takes a value apart into its leaves' columns. Returns how many bytes they have taken, about.
fn shred(value: &Value, like: &Value, place: Place, columns: &mut [Column]) -> Result<usize, ExportError> {
    match (value, like) {
        (Value::Struct(fields), Value::Struct(like)) => shred_fields(fields, like, place, columns),
        (Value::List(items), Value::List(like)) => {
            if items.is_empty() {
                columns.iter_mut().for_each(|column| column.push_levels(place));
                return Ok(columns.len() * 2 * size_of::<i16>());
            }
            let like = like.first().ok_or_else(|| unlike(value))?;
            let depth = place.depth + 1;
            let mut n_bytes = 0;
            for (idx, item) in items.iter().enumerate() {
                let repetition = if idx == 0 { place.repetition } else { depth };
                n_bytes += shred(item, like, Place { depth, repetition }, columns)?;
            }
            Ok(n_bytes)
        }
        (Value::List(_) | Value::Struct(_), _) => Err(unlike(value)),
        _ => columns.first_mut().ok_or_else(|| unlike(value))?.push(value, place),
    }
}

fn shred_fields(
    fields: &[(&'static str, Value)],
    like: &[(&'static str, Value)],
    place: Place,
    mut columns: &mut [Column],
) -> Result<usize, ExportError> {
    let mut n_bytes = 0;
    for ((_, value), (_, like)) in fields.iter().zip(like) {
        let (of_value, rest) = columns.split_at_mut(n_leaves(like));
        n_bytes += shred(value, like, place, of_value)?;
        columns = rest;
    }
    Ok(n_bytes)
}
