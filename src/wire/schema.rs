//! What messages look like in JSON, as JSON Schema; follows [`super::encode::json`].

use prost_reflect::{FieldDescriptor, Kind, MessageDescriptor};
use serde_json::{Map, Value, json};

use super::encode::{Named, descriptor};

/// Of a message that is sent, with those in it: it has all its fields.
pub fn reply<M: Named>() -> Value {
    of_message(&descriptor::<M>(), true)
}

/// Of a message that is read: what is not there has its default.
pub fn request<M: Named>() -> Value {
    of_message(&descriptor::<M>(), false)
}

fn of_message(message: &MessageDescriptor, whole: bool) -> Value {
    if message.full_name() == "google.protobuf.Timestamp" {
        return json!({ "type": "string", "format": "date-time" });
    }
    let fields = || message.fields();
    let properties: Map<String, Value> = fields()
        .map(|field| (field.name().to_owned(), of_field(&field, whole)))
        .collect();
    // Messages may be absent.
    let required: Vec<String> = fields()
        .filter(|field| whole && !field.supports_presence())
        .map(|field| field.name().to_owned())
        .collect();
    json!({ "type": "object", "properties": properties, "required": required })
}

fn of_field(field: &FieldDescriptor, whole: bool) -> Value {
    let one = match field.kind() {
        Kind::Double | Kind::Float => json!({ "type": "number" }),
        Kind::Uint32 | Kind::Fixed32 => json!({ "type": "integer", "minimum": 0 }),
        Kind::Int32 | Kind::Sint32 | Kind::Sfixed32 => json!({ "type": "integer" }),
        // JSON's numbers are not exact that far.
        Kind::Int64 | Kind::Sint64 | Kind::Sfixed64 | Kind::Uint64 | Kind::Fixed64 => {
            json!({ "type": "string", "pattern": "^-?[0-9]+$" })
        }
        Kind::Bool => json!({ "type": "boolean" }),
        Kind::String | Kind::Enum(_) => json!({ "type": "string" }),
        Kind::Bytes => json!({ "type": "string", "contentEncoding": "base64" }),
        Kind::Message(message) => of_message(&message, whole),
    };
    if field.is_list() {
        json!({ "type": "array", "items": one })
    } else {
        one
    }
}
