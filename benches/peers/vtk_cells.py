"""What VTK's mappers of unstructured grids take for the scenes of `chronoxel play --method cells`: the peers to measure against.

    python vtk_cells.py STEP.vtu… --array NAME --transfer TRANSFER.json --camera CAMERA.json --unit LENGTH
                        [--mapper projected|bunyk] [--turn] [--size 512] [--frames 24] [-o LAST.png]

The files are one mesh with a field at each step. TRANSFER.json and CAMERA.json are Chronoxel's, the first with its `domain` in
data units; --unit is the length that opacities refer to. A new step is drawn each frame, or with --turn the first of
them from cameras 15 degrees apart about the vertical through `look_at`. `projected` sorts tetrahedra and draws them with OpenGL, whatever driver
there is; `bunyk` casts rays on the CPU. Prints one JSON line; times are of all threads, read-back included.
Needs the PyPI packages vtk and numpy.
"""

import argparse
import json
import math
import statistics
import time

import vtk

MAPPERS = {
    "projected": vtk.vtkProjectedTetrahedraMapper,
    "bunyk": vtk.vtkUnstructuredGridVolumeRayCastMapper,
}


def read(path, name):
    reader = vtk.vtkXMLUnstructuredGridReader()
    reader.SetFileName(path)
    reader.Update()
    grid = reader.GetOutput()
    array = grid.GetPointData().GetArray(name)
    if array is None:
        raise SystemExit(f"{path}: no point data {name!r}")
    return grid, array


def volume_property(transfer, unit):
    color, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
    low, high = transfer["domain"]
    for point in transfer["points"]:
        x = low + (high - low) * point["x"]
        color.AddRGBPoint(x, *point["color"])
        opacity.AddPoint(x, point["opacity"])
    result = vtk.vtkVolumeProperty()
    result.SetColor(color)
    result.SetScalarOpacity(opacity)
    result.SetScalarOpacityUnitDistance(unit)
    result.SetInterpolationTypeToLinear()
    result.ShadeOff()
    return result


def turned(position, centre, degrees):
    angle = math.radians(degrees)
    x, z = position[0] - centre[0], position[2] - centre[2]
    return (
        centre[0] + x * math.cos(angle) + z * math.sin(angle),
        position[1],
        centre[2] - x * math.sin(angle) + z * math.cos(angle),
    )


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("steps", nargs="+")
    parser.add_argument("--array", required=True)
    parser.add_argument("--transfer", required=True)
    parser.add_argument("--camera", required=True)
    parser.add_argument("--unit", type=float, required=True)
    parser.add_argument("--mapper", choices=MAPPERS, default="projected")
    parser.add_argument("--turn", action="store_true")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("-o", "--output")
    args = parser.parse_args()

    grid, first = read(args.steps[0], args.array)
    arrays = [first] + [read(path, args.array)[1] for path in args.steps[1:]]
    grid.GetPointData().SetScalars(first)
    mapper = MAPPERS[args.mapper]()
    mapper.SetInputData(grid)
    if args.mapper == "bunyk":
        mapper.SetAutoAdjustSampleDistances(0)
        mapper.SetImageSampleDistance(1)
    volume = vtk.vtkVolume()
    volume.SetMapper(mapper)
    volume.SetProperty(volume_property(json.load(open(args.transfer)), args.unit))
    window, renderer = vtk.vtkRenderWindow(), vtk.vtkRenderer()
    window.SetOffScreenRendering(1)
    window.SetSize(args.size, args.size)
    window.SetMultiSamples(0)
    window.AddRenderer(renderer)
    renderer.AddVolume(volume)
    view = json.load(open(args.camera))
    camera = renderer.GetActiveCamera()
    camera.SetViewAngle(view["fov_y_deg"])
    pixels = vtk.vtkUnsignedCharArray()

    def frame(degrees):
        camera.SetPosition(*turned(view["position"], view["look_at"], degrees))
        camera.SetFocalPoint(*view["look_at"])
        camera.SetViewUp(*view["up"])
        renderer.ResetCameraClippingRange()
        window.Render()
        window.GetRGBACharPixelData(0, 0, args.size - 1, args.size - 1, 1, pixels)

    frame(0)
    wall, cpu = [], []
    for k in range(args.frames):
        w, c = time.perf_counter(), time.process_time()
        if not args.turn:
            grid.GetPointData().SetScalars(arrays[(k + 1) % len(arrays)])
            grid.Modified()
        frame(15 * (k + 1) if args.turn else 0)
        wall.append((time.perf_counter() - w) * 1e3)
        cpu.append((time.process_time() - c) * 1e3)
    if args.output:
        grab, writer = vtk.vtkWindowToImageFilter(), vtk.vtkPNGWriter()
        grab.SetInput(window)
        writer.SetInputConnection(grab.GetOutputPort())
        writer.SetFileName(args.output)
        writer.Write()
    report = {"mapper": mapper.GetClassName(), "tetrahedra": grid.GetNumberOfCells(), "frames": len(wall)}
    report |= {"wall_ms_p50": statistics.median(wall), "cpu_ms_p50": statistics.median(cpu)}
    print(json.dumps(report))


if __name__ == "__main__":
    main()
