//! Transfer functions from files: our JSON, and the presets that ParaView exports.
//!
//! Ours is `{"points":[{"x":0.0,"color":[r,g,b],"opacity":a},…]}` with `"domain"` absent (x in data units),
//! `[min, max]`, or `"variable"`, over which x runs from 0 to 1. Where no point has an opacity, it rises linearly from 0 at the first to
//! 0.05 at the last, as in the built-in `ramp`.
//!
//! A preset is a list of objects, of which the first with `RGBPoints` `[x, r, g, b, …]` is taken; its
//! `Points` `[x, opacity, midpoint, sharpness, …]` are the opacities, else the same rise. `ColorSpace` may be
//! `RGB`, `Lab` or `Diverging`. A preset whose colours span exactly [0, 1] or [-1, 1], as ParaView's own do,
//! is laid over the variable's range; any other is in data units.

use serde_json::{Map, Value};

use crate::{
    CoreError, TransferDomain, TransferFunction, TransferPoint, color,
    transfer::{RAMP_OPACITY, merge},
};

/// Linear pieces that stand for one segment of a preset whose colour space is curved in sRGB.
const PIECES_OF_CURVED_SEGMENT: usize = 32;

impl TransferFunction {
    /// A function from the text of a file, ours or a ParaView preset.
    ///
    /// # Errors
    /// [`CoreError::InvalidArgument`] naming the field and the value that cannot be used.
    pub fn from_json(text: &str) -> Result<Self, CoreError> {
        let value: Value = serde_json::from_str(text)
            .map_err(|e| CoreError::invalid("transfer function file", e, "it must be JSON"))?;
        match &value {
            Value::Array(presets) => from_presets(presets),
            Value::Object(object) if object.contains_key("RGBPoints") => from_preset(object),
            Value::Object(object) => from_points(object),
            other => {
                Err(wrong("transfer function file", other, "it must be an object, or a list of presets"))
            }
        }
    }
}

fn wrong(field: &'static str, value: &Value, remedy: &'static str) -> CoreError {
    let text: String = value.to_string().chars().take(60).collect();
    CoreError::invalid(field, text, remedy)
}

fn from_points(object: &Map<String, Value>) -> Result<TransferFunction, CoreError> {
    let missing = || {
        let remedy = "give a list of {\"x\", \"color\", \"opacity\"}, or a ParaView preset";
        CoreError::invalid("transfer function's points", "missing", remedy)
    };
    let list = object.get("points").ok_or_else(missing)?;
    let list = list.as_array().ok_or_else(|| wrong("transfer function's points", list, "give a list"))?;
    let domain = domain_of(object.get("domain"))?;
    let mut points = list.iter().map(point_of).collect::<Result<Vec<_>, _>>()?;
    // Data units beside a domain would put all of the function far outside the data: an empty picture.
    let outside = points.iter().find(|p| domain != TransferDomain::Data && !(0.0..=1.0).contains(&p.x));
    if let Some(point) = outside {
        let remedy = "with a domain x is in [0, 1]; leave the domain out to give x in data units";
        return Err(CoreError::invalid("transfer function's x", point.x, remedy));
    }
    let num_with = list.iter().filter(|p| p.get("opacity").is_some()).count();
    if num_with == 0 && !points.is_empty() {
        let (first, last) = (points[0].x, points[points.len() - 1].x);
        points.iter_mut().for_each(|p| p.opacity = ramp_opacity(p.x, first, last) as f32);
    } else if num_with < list.len() {
        let value = format!("missing at {} of {} points", list.len() - num_with, list.len());
        let remedy = "give it at every point, or at none";
        return Err(CoreError::invalid("transfer function's opacity", value, remedy));
    }
    TransferFunction::new(points, domain)
}

fn ramp_opacity(x: f64, first: f64, last: f64) -> f64 {
    if last > first { (RAMP_OPACITY * (x - first) / (last - first)).clamp(0.0, 1.0) } else { RAMP_OPACITY }
}

fn domain_of(value: Option<&Value>) -> Result<TransferDomain, CoreError> {
    match value {
        None | Some(Value::Null) => Ok(TransferDomain::Data),
        Some(Value::String(text)) if text == "variable" => Ok(TransferDomain::Variable),
        Some(value) => match numbers(value).as_deref() {
            Some([min, max]) => Ok(TransferDomain::Range([*min, *max])),
            _ => Err(wrong("transfer function's domain", value, "use [min, max] or \"variable\"")),
        },
    }
}

fn point_of(value: &Value) -> Result<TransferPoint, CoreError> {
    let null = Value::Null;
    let x = value.get("x").unwrap_or(&null);
    let color = value.get("color").unwrap_or(&null);
    let opacity = value.get("opacity");
    let Some(x) = x.as_f64() else {
        return Err(wrong("transfer function's x", x, "give a number at every point"));
    };
    let Some([r, g, b]) = numbers(color).and_then(|c| <[f64; 3]>::try_from(c).ok()) else {
        return Err(wrong("transfer function's color", color, "give three numbers in [0, 1]"));
    };
    let opacity = match opacity {
        None => 0.0,
        Some(value) => value
            .as_f64()
            .ok_or_else(|| wrong("transfer function's opacity", value, "give a number in [0, 1]"))?,
    };
    Ok(TransferPoint { x, color: [r, g, b].map(|c| c as f32), opacity: opacity as f32 })
}

fn numbers(value: &Value) -> Option<Vec<f64>> {
    value.as_array()?.iter().map(Value::as_f64).collect()
}

fn from_presets(presets: &[Value]) -> Result<TransferFunction, CoreError> {
    let with_colors = presets.iter().filter_map(Value::as_object).find(|p| p.contains_key("RGBPoints"));
    match with_colors {
        Some(preset) => from_preset(preset),
        None => {
            let remedy = "export a preset that has colours from ParaView";
            Err(CoreError::invalid("preset's RGBPoints", "missing", remedy))
        }
    }
}

fn from_preset(preset: &Map<String, Value>) -> Result<TransferFunction, CoreError> {
    let rows = rows_of_four("preset's RGBPoints", &preset["RGBPoints"])?;
    let colors: Vec<(f64, [f64; 3])> = rows.iter().map(|&[x, r, g, b]| (x, [r, g, b])).collect();
    let space = match preset.get("ColorSpace") {
        None => "RGB",
        Some(value) => value.as_str().unwrap_or_default(),
    };
    let colors = straightened(&colors, space)?;
    let (first, last) = (colors[0].0, colors[colors.len() - 1].0);
    let opacities = match preset.get("Points") {
        None | Some(Value::Null) => vec![(first, ramp_opacity(first, first, last)), (last, RAMP_OPACITY)],
        Some(value) => opacities_of(&rows_of_four("preset's Points", value)?)?,
    };
    let mut points = merge(&colors, &opacities);
    let is_normalized = last == 1.0 && (first == 0.0 || first == -1.0);
    if !is_normalized {
        return TransferFunction::new(points, TransferDomain::Data);
    }
    points.iter_mut().for_each(|p| p.x = (p.x - first) / (last - first));
    TransferFunction::new(points, TransferDomain::Variable)
}

/// Rows of four numbers, the first of each not decreasing; at least one row.
fn rows_of_four(field: &'static str, value: &Value) -> Result<Vec<[f64; 4]>, CoreError> {
    let remedy = "give a list of numbers, four for each point";
    let list = numbers(value).ok_or_else(|| wrong(field, value, remedy))?;
    if list.is_empty() || !list.len().is_multiple_of(4) {
        return Err(CoreError::invalid(field, format!("{} numbers", list.len()), remedy));
    }
    let rows: Vec<[f64; 4]> = list.chunks_exact(4).map(|c| [c[0], c[1], c[2], c[3]]).collect();
    if let Some(i) = (1..rows.len()).find(|&i| rows[i][0] < rows[i - 1][0]) {
        let value = format!("x = {} after {} at point {i}", rows[i][0], rows[i - 1][0]);
        return Err(CoreError::invalid(field, value, "x must not decrease"));
    }
    Ok(rows)
}

/// Opacities of ParaView's points; a midpoint is where a segment passes the mean of its ends.
fn opacities_of(rows: &[[f64; 4]]) -> Result<Vec<(f64, f64)>, CoreError> {
    let mut opacities = Vec::with_capacity(2 * rows.len());
    for (i, &[x, opacity, midpoint, sharpness]) in rows.iter().enumerate() {
        if !(0.0..=1.0).contains(&midpoint) {
            let value = format!("{midpoint} at point {i}");
            return Err(CoreError::invalid("preset's midpoint", value, "it must be in [0, 1]"));
        }
        if sharpness != 0.0 && i + 1 < rows.len() {
            let value = format!("{sharpness} at point {i}");
            return Err(CoreError::invalid(
                "preset's sharpness",
                value,
                "only 0 (straight lines) can be drawn",
            ));
        }
        opacities.push((x, opacity));
        if let Some(next) = rows.get(i + 1).filter(|next| midpoint != 0.5 && next[0] > x) {
            opacities.push((x + midpoint * (next[0] - x), (opacity + next[1]) / 2.0));
        }
    }
    Ok(opacities)
}

/// Colours with straight segments in sRGB, from points whose segments are straight in `space`.
fn straightened(points: &[(f64, [f64; 3])], space: &str) -> Result<Vec<(f64, [f32; 3])>, CoreError> {
    let between: fn([f64; 3], [f64; 3], f64) -> [f64; 3] = match space {
        "RGB" => return Ok(points.iter().map(|&(x, rgb)| (x, rgb.map(|c| c as f32))).collect()),
        "Lab" => |a, b, w| {
            let (a, b) = (color::lab_from_srgb(a), color::lab_from_srgb(b));
            color::srgb_from_lab(std::array::from_fn(|i| a[i] + (b[i] - a[i]) * w))
        },
        "Diverging" => |a, b, w| {
            let [a, b] = [a, b].map(|c| color::msh_from_lab(color::lab_from_srgb(c)));
            color::srgb_from_lab(color::lab_from_msh(color::diverging(a, b, w)))
        },
        other => {
            let remedy = "save the preset with the colour space RGB, Lab or Diverging";
            return Err(CoreError::invalid("preset's ColorSpace", format!("{other:?}"), remedy));
        }
    };
    let narrow = |rgb: [f64; 3]| rgb.map(|c| c as f32);
    let mut straight = vec![(points[0].0, narrow(points[0].1))];
    for pair in points.windows(2) {
        let ((x0, a), (x1, b)) = (pair[0], pair[1]);
        if x1 > x0 {
            straight.extend((1..PIECES_OF_CURVED_SEGMENT).map(|i| {
                let w = i as f64 / PIECES_OF_CURVED_SEGMENT as f64;
                (x0 + (x1 - x0) * w, narrow(between(a, b, w)))
            }));
        }
        straight.push((x1, narrow(b)));
    }
    Ok(straight)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn our_json_with_each_domain() {
        let points =
            r#""points":[{"x":0,"color":[1,0,0],"opacity":0},{"x":1,"color":[0,0,1],"opacity":0.5}]"#;
        let at = |domain: &str, v| {
            let text = format!("{{{points}{domain}}}");
            TransferFunction::from_json(&text).unwrap().resolve([100.0, 300.0]).unwrap().evaluate(v)
        };
        assert_eq!(at("", 0.5), [0.5, 0.0, 0.5, 0.25]);
        assert_eq!(at(r#","domain":[10,20]"#, 15.0), [0.5, 0.0, 0.5, 0.25]);
        assert_eq!(at(r#","domain":"variable""#, 200.0), [0.5, 0.0, 0.5, 0.25]);
    }

    #[test]
    fn opacity_left_out_rises_linearly() {
        let text = r#"{"points":[{"x":2,"color":[1,1,1]},{"x":6,"color":[0,0,0]}]}"#;
        let tf = TransferFunction::from_json(text).unwrap().resolve([0.0, 1.0]).unwrap();
        assert!((tf.evaluate(4.0)[3] - 0.025).abs() < 1e-8);
    }

    #[test]
    fn paraview_presets() {
        let text = r#"[{"Name":"x","ColorSpace":"RGB","RGBPoints":[10,0,0,0, 20,1,1,1],
            "Points":[10,0,0.5,0, 20,1,0.25,0, 30,0,0.5,0]}]"#;
        let tf = TransferFunction::from_json(text).unwrap().resolve([0.0, 1.0]).unwrap();
        assert_eq!(tf.evaluate(15.0), [0.5, 0.5, 0.5, 0.5]);
        assert_eq!(tf.evaluate(22.5)[3], 0.5, "the midpoint");
        assert_eq!(tf.evaluate(26.25)[3], 0.25);
    }

    #[test]
    fn normalized_presets_are_laid_over_the_variable() {
        let text = r#"[{"ColorSpace":"Diverging","Name":"Cool to Warm",
            "RGBPoints":[0,0.23137254902,0.298039215686,0.752941176471,1,0.705882352941,0.0156862745098,0.149019607843]}]"#;
        let tf = TransferFunction::from_json(text).unwrap().resolve([50.0, 70.0]).unwrap();
        // The centre of the published diverging map.
        for c in &tf.evaluate(60.0)[..3] {
            assert!((c - 0.865).abs() < 0.003, "{c}");
        }
        assert!((tf.evaluate(60.0)[3] - 0.025).abs() < 1e-8);
    }

    #[test]
    fn hostile_files_are_refused_by_field() {
        for (text, field) in [
            ("", "transfer function file"),
            ("[[[[", "transfer function file"),
            ("3", "transfer function file"),
            ("{}", "points"),
            ("[]", "RGBPoints"),
            (r#"{"points":7}"#, "points"),
            (r#"{"points":[]}"#, "points"),
            (r#"{"points":[{"x":"a","color":[0,0,0],"opacity":0}]}"#, "x is"),
            (r#"{"points":[{"x":0,"color":[0,0],"opacity":0}]}"#, "color"),
            (r#"{"points":[{"x":0,"color":[0,0,7],"opacity":0}]}"#, "color"),
            (r#"{"points":[{"x":0,"color":[0,0,0],"opacity":-1}]}"#, "opacity"),
            (r#"{"points":[{"x":0,"color":[0,0,0],"opacity":0},{"x":1,"color":[0,0,0]}]}"#, "opacity"),
            (r#"{"points":[{"x":0,"color":[0,0,0],"opacity":0}],"domain":[2,1]}"#, "domain"),
            (r#"{"points":[{"x":0,"color":[0,0,0],"opacity":0}],"domain":"all"}"#, "domain"),
            (r#"{"points":[{"x":20,"color":[0,0,0],"opacity":0}],"domain":[0,80]}"#, "leave the domain out"),
            (r#"{"points":[{"x":-1,"color":[0,0,0],"opacity":0}],"domain":"variable"}"#, "in [0, 1]"),
            (r#"[{"RGBPoints":[0,0,0]}]"#, "RGBPoints"),
            (r#"[{"RGBPoints":[0,0,0,0],"Points":[0,1,2,0]}]"#, "midpoint"),
            (r#"[{"RGBPoints":[0,0,0,0],"Points":[0,1,0.5,1,1,1,0.5,0]}]"#, "sharpness"),
            (r#"[{"RGBPoints":[0,0,0,0],"Points":[1,1,0.5,0,0,1,0.5,0]}]"#, "Points"),
            (r#"[{"RGBPoints":[0,0,0,0],"ColorSpace":"HSV"}]"#, "ColorSpace"),
        ] {
            let message = TransferFunction::from_json(text).unwrap_err().to_string();
            assert!(message.contains(field) && !message.contains('\n'), "{text}: {message}");
        }
    }
}
