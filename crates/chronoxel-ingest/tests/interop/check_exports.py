"""Reads what `tests/exports.rs` wrote with other programs: numpy, vtk and zarr-python.

    CHRONOXEL_EXPORTS=DIR cargo test --release -p chronoxel-ingest --test exports
    python check_exports.py DIR        (pip install numpy vtk zarr)

Compares grid, times and samples with the formula of that test; exits with 1 at the first difference.
"""

import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import zarr
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLImageDataReader

DIMS = (70, 5, 3)
ORIGIN = (1.5, -2.0, 0.25)
SPACING = (0.5, 1.0, 2.5)
TIMES = [0.5, 1.25, 2.0]
TYPES = {"u8": np.uint8, "i16": np.int16, "f32": np.float32, "f64": np.float64}
FILL = 99


def expected(kind, step):
    z, y, x = np.meshgrid(*[np.arange(n, dtype=float) for n in DIMS[::-1]], indexing="ij")
    v = 40.0 * step + 0.75 * x - 12.0 * y + 7.0 * z
    v[0, 4, 69] = np.nan
    kind = np.dtype(kind)
    if kind.kind in "iu":
        limits = np.iinfo(kind)
        whole = np.clip(np.sign(v) * np.floor(np.abs(v) + 0.5), limits.min, limits.max)
        v = np.where(np.isnan(v), FILL, whole)
    return v.astype(kind)


def check(what, found, wanted):
    if isinstance(wanted, np.ndarray):
        found = np.asarray(found)
        same = found.dtype == wanted.dtype and np.array_equal(found, wanted, equal_nan=wanted.dtype.kind == "f")
    else:
        same = found == wanted
    if not same:
        sys.exit(f"{what}: found {found}, expected {wanted}")


def check_vti(path, kind, step):
    reader = vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    image = reader.GetOutput()
    check(f"{path} dims", image.GetDimensions(), DIMS)
    check(f"{path} origin", image.GetOrigin(), ORIGIN)
    check(f"{path} spacing", image.GetSpacing(), SPACING)
    time = vtk_to_numpy(image.GetFieldData().GetArray("TimeValue"))
    check(f"{path} time", list(time), [TIMES[step]])
    array = image.GetPointData().GetScalars()
    check(f"{path} name", array.GetName(), "speed")
    check(f"{path} units", array.GetInformation().Get(array.UNITS_LABEL()), "m/s")
    check(f"{path} samples", vtk_to_numpy(array).reshape(DIMS[::-1]), expected(kind, step))


def read_nrrd(path):
    head, body = path.read_bytes().split(b"\n\n", 1)
    lines = head.decode("ascii").splitlines()
    check(f"{path} magic", lines[0], "NRRD0005")
    return dict(line.split(": ", 1) for line in lines[1:] if ": " in line), body


def check_nrrd(path, kind, num_steps):
    fields, body = read_nrrd(path)
    sizes = DIMS + ((3,) if num_steps > 1 else ())
    check(f"{path} sizes", tuple(int(n) for n in fields["sizes"].split()), sizes)
    directions = "(0.5,0,0) (0,1.0,0) (0,0,2.5)" + (" none" if num_steps > 1 else "")
    check(f"{path} directions", fields["space directions"], directions)
    check(f"{path} origin", fields["space origin"], "(1.5,-2.0,0.25)")
    if num_steps > 1:
        check(f"{path} spacings", fields["spacings"], "NaN NaN NaN 0.75")
        check(f"{path} axis mins", fields["axis mins"], "NaN NaN NaN 0.5")
    samples = np.frombuffer(body, np.dtype(kind)).reshape((num_steps,) + DIMS[::-1])
    check(f"{path} samples", samples, np.stack([expected(kind, s) for s in range(num_steps)]))


def check_zarr(path, kind):
    group = zarr.open_group(str(path), mode="r")
    array = group["speed"]
    check(f"{path} samples", array[:], np.stack([expected(kind, s) for s in range(3)]))
    check(f"{path} names", tuple(array.metadata.dimension_names), ("t", "z", "y", "x"))
    check(f"{path} units", (array.attrs["units"], group["t"].attrs["units"]), ("m/s", "h"))
    check(f"{path} times", group["t"][:], np.array(TIMES))
    for axis, name in enumerate("xyz"):
        check(f"{path} {name}", group[name][:], ORIGIN[axis] + SPACING[axis] * np.arange(DIMS[axis]))
    if np.dtype(kind).kind in "iu":
        check(f"{path} fill value", (array.fill_value, array.attrs["_FillValue"]), (FILL, FILL))


def main(folder):
    for label, kind in TYPES.items():
        check(f"{label} npy", np.load(folder / f"{label}_1.npy"), expected(kind, 0))
        check(f"{label} npy", np.load(folder / f"{label}_3.npy"), np.stack([expected(kind, s) for s in range(3)]))
        check_vti(folder / f"{label}_1.vti", kind, 0)
        entries = ElementTree.parse(folder / f"{label}_3.pvd").getroot().iter("DataSet")
        for step, entry in enumerate(entries):
            check(f"{label} pvd", float(entry.get("timestep")), TIMES[step])
            check_vti(folder / entry.get("file"), kind, step)
        check_nrrd(folder / f"{label}_1.nrrd", kind, 1)
        check_nrrd(folder / f"{label}_3.nrrd", kind, 3)
        check_zarr(folder / f"{label}_3.zarr", kind)
    print(f"{folder}: exports of {len(TYPES)} types agree")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
