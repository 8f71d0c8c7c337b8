"""What VTK's CPU ray caster takes for the scenes of `chronoxel play`: the peer to measure against.

    python vtk_raycast.py SERIES.npy TRANSFER.json [--shade] [--play] [--size 512] [--frames 24] [-o LAST.png]

SERIES.npy is [t, z, y, x]; floats are quantised to 8 bits over the transfer function's domain, as
VTK's fixed-point mapper does best with bytes. TRANSFER.json is a Chronoxel transfer function whose
`domain` is given in data units; its opacities refer to one voxel. The camera stands at elevation 20
degrees, 4.0561 volume edges away, with a field of view of 30 degrees, so that the volume covers a third of the picture,
and turns by 15 degrees a frame (or stands still, a new step each frame, with --play).
Samples are half a voxel apart. Prints one JSON line; times are of all threads, read-back included.
Needs the PyPI packages vtk and numpy.
"""

import argparse
import json
import math
import statistics
import time

import numpy as np
import vtk
from vtk.util.numpy_support import numpy_to_vtk

DISTANCE_IN_EDGES = 4.0561


def quantised(series, low, high):
    if series.dtype == np.uint8:
        return [np.ascontiguousarray(step) for step in series]
    scale = 255.0 / (high - low)
    return [np.rint(np.clip((step - low) * scale, 0, 255)).astype(np.uint8) for step in series]


def image_of(step):
    nz, ny, nx = step.shape
    image = vtk.vtkImageData()
    image.SetDimensions(nx, ny, nz)
    image.SetOrigin(-(nx - 1) / 2, -(ny - 1) / 2, -(nz - 1) / 2)
    scalars = numpy_to_vtk(step.ravel(), deep=0)
    image.GetPointData().SetScalars(scalars)
    image.kept = step
    return image


def volume_property(transfer, shade):
    color, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
    low, high = transfer["domain"]
    for point in transfer["points"]:
        color.AddRGBPoint(point["x"] * 255, *point["color"])
        opacity.AddPoint(point["x"] * 255, point["opacity"])
    result = vtk.vtkVolumeProperty()
    result.SetColor(color)
    result.SetScalarOpacity(opacity)
    result.SetScalarOpacityUnitDistance(1)
    result.SetInterpolationTypeToLinear()
    result.SetShade(shade)
    return result, low, high


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("series")
    parser.add_argument("transfer")
    parser.add_argument("--shade", action="store_true")
    parser.add_argument("--play", action="store_true")
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("-o", "--output")
    args = parser.parse_args()

    prop, low, high = volume_property(json.load(open(args.transfer)), args.shade)
    series = np.load(args.series, mmap_mode="r")
    middle = len(series) // 2
    steps = quantised(series if args.play else series[middle : middle + 1], low, high)

    mapper = vtk.vtkFixedPointVolumeRayCastMapper()
    mapper.SetAutoAdjustSampleDistances(0)
    mapper.SetSampleDistance(0.5)
    mapper.SetImageSampleDistance(1)
    mapper.SetInputData(image_of(steps[0]))
    volume = vtk.vtkVolume()
    volume.SetMapper(mapper)
    volume.SetProperty(prop)
    window, renderer = vtk.vtkRenderWindow(), vtk.vtkRenderer()
    window.SetOffScreenRendering(1)
    window.SetSize(args.size, args.size)
    window.SetMultiSamples(0)
    window.AddRenderer(renderer)
    renderer.AddVolume(volume)
    camera = renderer.GetActiveCamera()
    camera.SetViewAngle(30)
    distance = DISTANCE_IN_EDGES * max(steps[0].shape)
    pixels = vtk.vtkUnsignedCharArray()

    def frame(azimuth):
        a, e = math.radians(azimuth), math.radians(20)
        camera.SetPosition(
            distance * math.sin(a) * math.cos(e), distance * math.sin(e), distance * math.cos(a) * math.cos(e)
        )
        camera.SetFocalPoint(0, 0, 0)
        camera.SetViewUp(0, 1, 0)
        renderer.ResetCameraClippingRange()
        window.Render()
        window.GetRGBACharPixelData(0, 0, args.size - 1, args.size - 1, 1, pixels)

    frame(30)
    wall, cpu = [], []
    for k in range(args.frames):
        if args.play:
            mapper.SetInputData(image_of(steps[k % len(steps)]))
        w, c = time.perf_counter(), time.process_time()
        frame(30 if args.play else 15 * k)
        wall.append((time.perf_counter() - w) * 1e3)
        cpu.append((time.process_time() - c) * 1e3)
    if args.output:
        grab, writer = vtk.vtkWindowToImageFilter(), vtk.vtkPNGWriter()
        grab.SetInput(window)
        writer.SetInputConnection(grab.GetOutputPort())
        writer.SetFileName(args.output)
        writer.Write()
    print(
        json.dumps(
            {
                "peer": f"VTK {vtk.vtkVersion.GetVTKVersion()} vtkFixedPointVolumeRayCastMapper",
                "shade": args.shade,
                "frames": args.frames,
                "cpu_ms_p50": round(statistics.median(cpu), 1),
                "cpu_ms_min": round(min(cpu), 1),
                "wall_ms_p50": round(statistics.median(wall), 1),
            }
        )
    )


if __name__ == "__main__":
    main()
