//! NumPy arrays written by `numpy`.

use chronoxel_core::SampleType;

use crate::fixtures::{check, expected, open, read, refused};

#[test]
fn every_type_in_both_byte_orders() {
    let names = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"];
    for (name, sample_type) in names.into_iter().zip(SampleType::ALL) {
        check(&format!("npy/{name}.npy"), sample_type, 1, false);
        check(&format!("npy/{name}_big.npy"), sample_type, 1, false);
    }
}

#[test]
fn every_version_steps_and_fortran_order() {
    for version in 1..=3 {
        check(&format!("npy/version{version}.npy"), SampleType::I16, 1, false);
    }
    check("npy/steps.npy", SampleType::F32, 2, false);
    check("npy/fortran.npy", SampleType::F32, 1, false);
    check("npy/fortran_steps.npy", SampleType::F64, 2, false);
    assert_eq!(open("npy/steps.npy").unwrap().variables()[0].name, "steps");
}

#[test]
fn what_is_not_a_volume_is_refused() {
    assert!(refused("npy/refused_complex.npy").contains("descr is <c8"));
    assert!(refused("npy/refused_2d.npy").contains("shape is [4, 5]"));
    assert!(refused("npy/refused_record.npy").contains("descr is [("));
}

#[test]
fn integers_beyond_53_bits_are_refused_and_those_of_53_are_exact() {
    let mut series = open("npy/exact_wide.npy").unwrap();
    let mut values = expected(SampleType::I64, 0);
    *values.last_mut().unwrap() = -(2f64.powi(53));
    assert_eq!(read(series.as_mut(), 0, 0), values);
    let mut series = open("npy/refused_wide.npy").unwrap();
    let error = series.open_step(0, 0).unwrap().read_slices(3).unwrap_err().to_string();
    assert!(error.contains("refused_wide.npy") && error.contains("-9007199254740993"), "{error}");
}
