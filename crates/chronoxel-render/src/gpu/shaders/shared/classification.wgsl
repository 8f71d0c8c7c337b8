// Classification: which colour of a table a number has. Twin: `twins::color_index`.

// index_from_number: factor and offset
fn color_index(number: f32, index_from_number: vec2<f32>, num_colors: u32) -> u32 {
    return u32(clamp(number * index_from_number.x + index_from_number.y, 0.0, f32(num_colors - 1u)));
}
