//! The text of a header: the attributes of a group's `zarr.json`, a line for each field, and a checksum over it all.

use std::path::Path;

use serde::{Serialize, de::DeserializeOwned};
use serde_json::{Value, json};

use crate::StoreError;

/// The text of a group's `zarr.json`: a line for each field of the header. Its last field is the CRC-32C of the text itself with
/// that field's digits as zeros.
///
/// * `attribute`: the name under which the header lies
pub(crate) fn to_text<H: Serialize>(attribute: &str, header: &H) -> Result<String, StoreError> {
    let failed = |e: serde_json::Error| StoreError::invalid("header", e, "it must be plain JSON");
    let mut fields = serde_json::to_value(header).map_err(failed)?;
    fields[CRC_FIELD] = json!(CRC_BLANK);
    let fields = fields.as_object().into_iter().flatten();
    let lines: Vec<String> = fields.map(|(name, value)| format!("  {name:?}: {value}")).collect();
    let mut text = format!(
        "{{\"zarr_format\": 3, \"node_type\": \"group\", \"attributes\": {{\"{attribute}\": {{\n{}\n}}}}}}\n",
        lines.join(",\n")
    );
    let at = crc_position(&text).ok_or_else(|| StoreError::invalid("header", "", "it has no checksum"))?;
    let crc = format!("{:08x}", crc32c::crc32c(text.as_bytes()));
    text.replace_range(at..at + CRC_BLANK.len(), &crc);
    Ok(text)
}

/// The header from the text of `zarr.json`, its version and checksum found right.
pub(crate) fn from_text<H: DeserializeOwned>(
    path: &Path,
    text: &str,
    attribute: &str,
    version: u32,
) -> Result<H, StoreError> {
    let corrupt =
        |field: &str, value: String, problem: &str| StoreError::corrupt(path, field, value, problem);
    let document: Value = serde_json::from_str(text)
        .map_err(|e| corrupt("JSON", e.to_string(), "this is not the header of a Zarr group"))?;
    let name = format!("attributes.{attribute}");
    let Some(fields) = document.pointer(&format!("/attributes/{attribute}")) else {
        return Err(corrupt(&name, "absent".into(), "this is not a Chronoxel store"));
    };
    let found = fields.get("version").and_then(Value::as_u64);
    if found != Some(u64::from(version)) {
        return Err(StoreError::Unsupported {
            path: path.to_owned(),
            field: "version",
            value: found.map_or("absent".into(), |v| v.to_string()),
            remedy: "this program reads version 1",
        });
    }
    check_crc(path, text)?;
    let mut fields = fields.clone();
    fields.as_object_mut().map(|object| object.remove(CRC_FIELD));
    serde_json::from_value(fields).map_err(|e| corrupt(&name, e.to_string(), "see the format"))
}

const CRC_FIELD: &str = "z_crc32c";
const CRC_BLANK: &str = "00000000";

fn crc_position(text: &str) -> Option<usize> {
    let key = format!("\"{CRC_FIELD}\": \"");
    let at = text.rfind(&key)? + key.len();
    let digits = text.get(at..at + CRC_BLANK.len())?;
    digits.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f')).then_some(at)
}

fn check_crc(path: &Path, text: &str) -> Result<(), StoreError> {
    let Some(at) = crc_position(text) else {
        return Err(StoreError::corrupt(path, CRC_FIELD, "absent", "the header has no checksum"));
    };
    let stored = &text[at..at + CRC_BLANK.len()];
    let blank = [&text[..at], CRC_BLANK, &text[at + CRC_BLANK.len()..]].concat();
    let computed = format!("{:08x}", crc32c::crc32c(blank.as_bytes()));
    if stored != computed {
        let problem = format!("the checksum of the header is {computed}: the file is damaged");
        return Err(StoreError::corrupt(path, CRC_FIELD, stored, problem));
    }
    Ok(())
}

/// JSON has no NaN and no infinities: they are written as Zarr writes them, as strings.
pub(crate) mod json_number {
    use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

    #[derive(Serialize, Deserialize)]
    #[serde(untagged)]
    enum Number {
        Finite(f64),
        Named(String),
    }

    pub fn serialize<S: Serializer>(value: &Option<f64>, serializer: S) -> Result<S::Ok, S::Error> {
        let number = value.map(|v| match v {
            v if v.is_nan() => Number::Named("NaN".into()),
            f64::INFINITY => Number::Named("Infinity".into()),
            f64::NEG_INFINITY => Number::Named("-Infinity".into()),
            v => Number::Finite(v),
        });
        number.serialize(serializer)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<f64>, D::Error> {
        match Option::<Number>::deserialize(deserializer)? {
            None => Ok(None),
            Some(Number::Finite(v)) => Ok(Some(v)),
            Some(Number::Named(name)) => match name.as_str() {
                "NaN" => Ok(Some(f64::NAN)),
                "Infinity" => Ok(Some(f64::INFINITY)),
                "-Infinity" => Ok(Some(f64::NEG_INFINITY)),
                _ => Err(D::Error::custom(format!("{name:?} is not a number"))),
            },
        }
    }
}
