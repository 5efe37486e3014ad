"""Cameras: the section `camera`, where it sees a direction, and calibrations of OpenCV and ROS.

Intrinsics and lens distortion are OpenCV's. Image coordinates are in pixels, `[..., 2]` (column, row), and (0.5, 0.5)
is the first pixel's centre; OpenCV's own are half a pixel less. Tangents are x/z and y/z of a direction in the camera
frame.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal
from xml.etree import ElementTree

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray
from pydantic import BeforeValidator, Field, model_validator

from spadwarp.arrays import Floats
from spadwarp.io.text import parse_json, read_text, write_text
from spadwarp.scene.port import Port
from spadwarp.scene.pose import rotation_matrix
from spadwarp.scene.sections import Coordinate, File, Infinite, Section, Vector, Whole, field, field_range
from spadwarp.values import ArgumentError, ConfigError, FileError, check_integer, read_real, shown

__all__ = ["Camera", "load_calibration", "save_calibration"]

_INTRINSICS = ("fx", "fy", "cx", "cy", "calibration")


def _padded(value: Any) -> Any:
    """Four coefficients of distortion lack k3, as OpenCV allows."""
    return (*value, 0.0) if isinstance(value, tuple) and len(value) == 4 else value


Brown = Annotated[tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate], BeforeValidator(_padded)]


class Camera(Section):
    """A view through a thin lens, which fills a round aperture, or through a point with the aperture's area.

    The view is given by `horizontal_fov_deg`, by `focal_length` with `pixel_pitch_um`, or by OpenCV's `fx` (with `fy`,
    `cx`, `cy`), which `calibration` reads from a file; the aperture by `aperture_diameter`, or by `f_number` with
    `focal_length`.
    """

    section: ClassVar[str] = "camera"
    displaces: ClassVar = {
        "horizontal_fov_deg": ("pixel_pitch_um", *_INTRINSICS),
        "pixel_pitch_um": ("horizontal_fov_deg", *_INTRINSICS),
        "fx": ("horizontal_fov_deg", "pixel_pitch_um"),
        "calibration": ("horizontal_fov_deg", "pixel_pitch_um", *_INTRINSICS, "distortion"),
        "aperture_diameter": ("f_number",),
        "f_number": ("aperture_diameter",),
    }
    preset: str | None = field(None, "a named camera, see `spadwarp list presets camera`")
    width: Whole = field(..., "pixels in a row", "[1, 16384]")
    height: Whole = field(..., "rows", "[1, 16384]")
    horizontal_fov_deg: float | None = field(None, "full horizontal field of view [°]", "[1e-6, 180)")
    focal_length: float | None = field(None, "focal length [m]", "[1e-6, 1e6]")
    pixel_pitch_um: float | None = field(None, "side of a pixel [µm]", "[1e-9, 1e6]")
    fx: float | None = field(None, "focal length along rows [pixels], as OpenCV writes it", "[0.001, 1e9]")
    fy: float | None = field(None, "focal length along columns [pixels]; fx if not given", "[0.001, 1e9]")
    cx: Coordinate | None = field(None, "column of the optical axis, 0 at the first pixel's centre; default: middle")
    cy: Coordinate | None = field(None, "row of the optical axis, likewise")
    distortion: Brown = field((0.0,) * 5, "Brown's lens distortion k1, k2, p1, p2, k3, OpenCV's order")
    calibration: File = field(None, "OpenCV's YAML or JSON file, whose fx, fy, cx, cy and distortion take its place")
    aperture_diameter: float | None = field(None, "diameter of the entrance aperture [m]", "[1e-9, 1e6]")
    f_number: float | None = field(None, "focal length over aperture diameter", "[0.001, 1e6]")
    focus_distance: Annotated[
        Annotated[float, Field(ge=1e-6, le=math.inf, allow_inf_nan=True)] | Literal["target"], Infinite
    ] = "target"
    """depth that is imaged sharply [m], inf or "infinity"; "target": that of the first target on the optical axis"""
    pinhole: bool = field(False, "whether the lens is a point: all depths sharp, the light of the aperture's area")
    position: Vector = field((0.0, 0.0, 0.0), "lens centre in the world [m]")
    rotation_deg: Vector = field((0.0, 0.0, 0.0), "rotations from the world's axes about x, the new y, the new z [°]")
    polarisation: Literal["none", "analyser", "stokes"] = "none"
    """what it records of polarisation: nothing; light through an analyser and one across; the Stokes vector"""
    analyser_angle_deg: float = Field(0.0, ge=-180, le=180)
    """analyser: direction of the field that it lets through, in the image from +x towards +y [°]"""
    analyser_extinction_ratio: Annotated[float, Field(ge=1, le=math.inf, allow_inf_nan=True), Infinite] = math.inf
    """analyser: light that it lets through along its direction over light across; inf or "infinity" is ideal"""
    port: Port | None = field(None, "what it looks through; view and focus are those in air; without it in water")

    @model_validator(mode="before")
    @classmethod
    def _read_calibration(cls, fields: Any) -> Any:
        if not isinstance(fields, Mapping) or not isinstance(fields.get("calibration"), str):
            return fields
        read = load_calibration(fields["calibration"])
        for name in ("width", "height"):
            if fields.get(name, read.get(name)) != read.get(name, fields.get(name)):
                raise ValueError(f"{name} = {fields[name]} is not {read[name]}, the image's of the calibration")
        return {**read, **{name: value for name, value in fields.items() if name != "calibration"}}

    def _problems(self) -> Iterator[str]:
        given = [name for name in ("horizontal_fov_deg", "pixel_pitch_um", "fx") if getattr(self, name) is not None]
        if len(given) != 1:
            hint = f"; given: {', '.join(given)}" if given else ""
            yield f"needs one of horizontal_fov_deg, fx, and pixel_pitch_um with focal_length{hint}"
        if (self.aperture_diameter is None) == (self.f_number is None):
            yield "needs either aperture_diameter or f_number with focal_length"
        needs_it = [name for name in ("f_number", "pixel_pitch_um") if getattr(self, name) is not None]
        if self.focal_length is None and needs_it:
            yield f"focal_length is missing; {needs_it[0]} needs it"
        yield from self._only_with("fx", self.fx is not None, "fy", "cx", "cy")
        if self.focus_distance != "target" and self.focus_distance <= (self.focal_length or 0.0):
            yield self._that("focus_distance", f"is outside ({self.focal_length}, inf] m, beyond the focal length")
        if not is_invertible(self):
            size = f"{self.width} x {self.height}"
            yield self._that("distortion", f"is not one-to-one: some of its {size} pixels show no direction, or two")

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the polarisation in a result: ("co", "cross") of an analyser and of one across it, the Stokes vector
        ("I", "Q", "U", "V"), or nothing."""
        return {"none": (), "analyser": ("co", "cross"), "stokes": ("I", "Q", "U", "V")}[self.polarisation]

    @property
    def focal_pixels(self) -> tuple[float, float]:
        """Focal length in pixels along rows and columns, fx and fy: image distance over pixel pitch."""
        if self.fx is not None:
            return self.fx, self.fy or self.fx
        tangent = self.pixel_tangent
        return 1.0 / tangent, 1.0 / tangent

    @property
    def principal_point(self) -> tuple[float, float]:
        """Image coordinates (column, row) of the optical axis, (0.5, 0.5) being the first pixel's centre."""
        middle = zip((self.cx, self.cy), (self.width, self.height), strict=True)
        column, row = (size / 2.0 if at is None else at + 0.5 for at, size in middle)
        return column, row

    @property
    def pixel_tangent(self) -> float:
        """Pixel pitch over image distance; the geometric mean of both directions where fx and fy differ.

        The image distance is 1/(1/f − 1/d) for a `focus_distance` d in metres, else the focal length f: with "target"
        the field of view does not depend on where the targets are.
        """
        if self.horizontal_fov_deg is not None:
            return 2.0 * math.tan(math.radians(self.horizontal_fov_deg) / 2.0) / self.width
        if self.fx is not None:
            return 1.0 / math.sqrt(self.fx * (self.fy or self.fx))
        assert self.pixel_pitch_um is not None and self.focal_length is not None
        pitch = self.pixel_pitch_um * 1e-6
        return pitch / self.focal_length - (0.0 if self.focus_distance == "target" else pitch / self.focus_distance)

    @property
    def is_posed(self) -> bool:
        """Whether its frame is not the world's."""
        return any((*self.position, *self.rotation_deg))

    @property
    def is_plain(self) -> bool:
        """Whether it has square pixels about the optical axis and no distortion."""
        fx, fy = self.focal_pixels
        middle = (self.width / 2.0, self.height / 2.0)
        return fx == fy and self.principal_point == middle and not any(self.distortion)

    @property
    def view_box(self) -> tuple[float, float, float, float]:
        """Least and largest tangents (left, top, right, bottom) of what the image shows."""
        if any(self.distortion):
            return view_box(self)
        (fx, fy), (cx, cy) = self.focal_pixels, self.principal_point
        return -cx / fx, -cy / fy, (self.width - cx) / fx, (self.height - cy) / fy

    @property
    def horizontal_fov(self) -> float:
        """Full horizontal field of view [rad]."""
        left, _, right, _ = self.view_box
        return math.atan(right) - math.atan(left)

    @property
    def vertical_fov(self) -> float:
        """Full vertical field of view [rad]."""
        _, top, _, bottom = self.view_box
        return math.atan(bottom) - math.atan(top)

    @property
    def aperture_radius(self) -> float:
        """Radius of the entrance aperture [m]."""
        if self.aperture_diameter is not None:
            return self.aperture_diameter / 2.0
        assert self.focal_length is not None and self.f_number is not None
        return self.focal_length / self.f_number / 2.0

    @property
    def aperture_area(self) -> float:
        """Area of the entrance aperture [m²]."""
        return math.pi * self.aperture_radius**2


def to_camera(camera: Camera, points: ArrayLike) -> Floats:
    """Points of the world `[..., 3]` [m] in the camera's frame."""
    return (np.asarray(points, np.float64) - camera.position) @ rotation_matrix(camera.rotation_deg)


def to_world(camera: Camera, points: ArrayLike) -> Floats:
    """Points of the camera's frame `[..., 3]` [m] in the world."""
    return np.asarray(points, np.float64) @ rotation_matrix(camera.rotation_deg).T + camera.position


# Intrinsics

# Boxes are wider by this part of a pixel than what they hold: edges bend between the points that are looked at, and
# float32 rounds.
_MARGIN = 0.01


def image_points(camera: Camera, tangents: ArrayLike) -> Floats:
    """Image coordinates at which directions with the given tangents are seen, `[..., 2]`."""
    seen, _ = _distort(np.asarray(tangents, np.float64), camera.distortion)
    return seen * camera.focal_pixels + camera.principal_point


def image_tangents(camera: Camera, points: ArrayLike) -> Floats:
    """Tangents of the directions that are seen at image coordinates, `[..., 2]`: `image_points` undone, by Newton's
    method; NaN where no direction is seen."""
    seen = (np.asarray(points, np.float64) - camera.principal_point) / camera.focal_pixels
    if not any(camera.distortion):
        return seen
    tangents = seen.copy()
    with np.errstate(all="ignore"):
        for _ in range(50):
            distorted, (a, b, d) = _distort(tangents, camera.distortion)
            error = distorted - seen
            step = np.stack([d * error[..., 0] - b * error[..., 1], a * error[..., 1] - b * error[..., 0]], axis=-1)
            tangents -= step / (a * d - b * b)[..., None]
            if np.nanmax(np.abs(error), initial=0.0) < 1e-14:
                break
        error = np.abs(_distort(tangents, camera.distortion)[0] - seen).max(axis=-1)
        tangents[~(error < 1e-10)] = np.nan
    return tangents


def pixel_directions(camera: Camera) -> Floats:
    """Unit vectors from the lens centre through the pixel centres, float64 `[H, W, 3]`."""
    centres = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), axis=-1)
    rays = np.concatenate([image_tangents(camera, centres), np.ones((camera.height, camera.width, 1))], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def is_invertible(camera: Camera) -> bool:
    """Whether each point of the image belongs to one direction of the view.

    The distortion is the gradient of a function of the tangents, so that a positive definite Jacobian throughout a
    convex region makes it one-to-one in it; tested on a grid over the box that holds the view.
    """
    if not any(camera.distortion):
        return True
    left, top, right, bottom = view_box(camera)
    if not np.isfinite([left, top, right, bottom]).all():
        return False
    _, (a, b, d) = _distort(_grid(np.linspace(left, right, 65), np.linspace(top, bottom, 65)), camera.distortion)
    return bool((a + d > 0.0).all() and (a * d - b * b > 0.0).all())


def view_box(camera: Camera) -> tuple[float, float, float, float]:
    """Least and largest tangents (left, top, right, bottom) of what the image shows, a hundredth of a pixel wider."""
    columns, rows = np.arange(camera.width + 1.0), np.arange(camera.height + 1.0)
    if not any(camera.distortion):
        columns, rows = columns[[0, -1]], rows[[0, -1]]
    border = [_grid(columns, rows[[0, -1]]).reshape(-1, 2), _grid(columns[[0, -1]], rows).reshape(-1, 2)]
    left, top, right, bottom = _boxes(camera, image_tangents(camera, np.concatenate(border))).tolist()
    return left, top, right, bottom


def pixel_views(camera: Camera) -> Floats:
    """As `view_box` for each pixel alone: `[H, W, 4]`."""
    corners = image_tangents(camera, _grid(np.arange(camera.width + 1.0), np.arange(camera.height + 1.0)))
    return _boxes(camera, np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]]))


def _boxes(camera: Camera, tangents: Floats) -> Floats:
    """Boxes `[..., 4]` that hold tangents `[N, ..., 2]`."""
    margin = _MARGIN / np.array(camera.focal_pixels)
    return np.concatenate([tangents.min(axis=0) - margin, tangents.max(axis=0) + margin], axis=-1)


def camera_attributes(camera: Camera, focus_distance: float | None) -> dict[str, NDArray[np.float64] | float]:
    """Attributes of a camera in a file, for readers without spadwarp: OpenCV's `camera_matrix` [pixels], 0 being the
    first pixel's centre, and `camera_distortion` (k1, k2, p1, p2, k3); `camera_position` [m] and `camera_rotation`, the
    camera's axes in the world as columns; `camera_focus_distance` [m], NaN if all depths are sharp.

    The matrices `[3, 3]` are 9 numbers, row after row: netCDF knows no attributes of two dimensions."""
    (fx, fy), (column, row) = camera.focal_pixels, camera.principal_point
    return {
        "camera_matrix": np.array([fx, 0.0, column - 0.5, 0.0, fy, row - 0.5, 0.0, 0.0, 1.0]),
        "camera_distortion": np.array(camera.distortion),
        "camera_position": np.array(camera.position),
        "camera_rotation": rotation_matrix(camera.rotation_deg).ravel(),
        "camera_focus_distance": np.nan if focus_distance is None else focus_distance,
    }


def _grid(columns: Floats, rows: Floats) -> Floats:
    """`[R, C, 2]`."""
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def _distort(tangents: Floats, coefficients: tuple[float, ...]) -> tuple[Floats, tuple[Floats, Floats, Floats]]:
    """Brown's model (1966) in OpenCV's order k1, k2, p1, p2, k3; and its derivatives: of x by x, of x by y and of y by
    x, which are the same, of y by y."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = tangents[..., 0], tangents[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))  # of the radial factor by r², twice
    column = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    row = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([column, row], axis=-1), (
        radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


# Calibrations

CALIBRATION_ENDINGS = (".xml", ".yml", ".yaml", ".json")
"""Of files that `save_calibration` writes."""

_COORDINATE = field_range(Camera, "cx")
_LARGEST = 1 << 19  # bytes; one with all corners of 100 views has 300 kB

# What programs call the same thing, OpenCV's name first.
_NAMES = (
    ("camera_matrix", "cameraMatrix", "intrinsic_matrix", "mtx", "K", "M"),
    ("distortion_coefficients", "dist_coeffs", "dist_coeff", "distCoeffs", "distortion", "dist", "D"),
    ("image_width", "width"),
    ("image_height", "height"),
)


def load_calibration(path: str | Path) -> dict[str, Any]:
    """Fields of the scene's `camera` section from a calibration file.

    Reads `camera_matrix` (3 × 3), `distortion_coefficients` (k1, k2, p1, p2[, k3]) and, if there, `image_width` and
    `image_height`, under these or the other usual names, as `fx`, `fy`, `cx`, `cy`, `distortion` [pixels, 1], and
    `width` and `height`. Raises `FileError` if the file cannot be read, `ConfigError` if it holds no calibration, one
    of a lens model other than Brown's, or numbers that are not finite.
    """
    try:
        return _fields(_entries(read_text(path, largest=_LARGEST)))
    except FileError as error:
        raise FileError(f"camera.calibration = {error}") from None
    except ValueError as error:
        raise ConfigError(f"camera.calibration = {str(path)!r}: {error}") from None


def save_calibration(camera: Camera, path: str | Path) -> Path:
    """Writes a camera's calibration as OpenCV's `cv::FileStorage` reads it: XML, YAML or JSON by the ending.

    Holds `image_width`, `image_height`, `camera_matrix` and `distortion_coefficients` (k1, k2, p1, p2, k3), as
    `cv2.calibrateCamera` gives them: 0 is the centre of the first pixel. Raises `ArgumentError` for another ending,
    `FileError` if the file cannot be written.
    """
    path = Path(path)
    if (ending := path.suffix.lower()) not in CALIBRATION_ENDINGS:
        raise ArgumentError(f"{path}: ending {path.suffix!r} is not one of {', '.join(CALIBRATION_ENDINGS)}")
    numbers: Any = camera_attributes(camera, None)
    entries: dict[str, Any] = {"image_width": camera.width, "image_height": camera.height}
    for name, rows, values in (("camera_matrix", 3, "matrix"), ("distortion_coefficients", 1, "distortion")):
        data = numbers[f"camera_{values}"].tolist()
        entries[name] = {"type_id": "opencv-matrix", "rows": rows, "cols": len(data) // rows, "dt": "d", "data": data}
    if ending == ".json":
        return write_text(json.dumps(entries, indent=1) + "\n", path)
    return write_text("\n".join([*_lines(entries, ending == ".xml"), ""]), path)


def _lines(entries: Mapping[str, Any], xml: bool) -> Iterator[str]:
    """Lines of the entries in XML or YAML."""
    yield from ('<?xml version="1.0"?>', "<opencv_storage>") if xml else ("%YAML:1.0", "---")
    for name, value in entries.items():
        if not isinstance(value, Mapping):
            yield f"<{name}>{value}</{name}>" if xml else f"{name}: {value}"
            continue
        yield f'<{name} type_id="opencv-matrix">' if xml else f"{name}: !!opencv-matrix"
        numbers = map(repr, value["data"])
        parts = {**value, "data": " ".join(numbers) if xml else f"[ {', '.join(numbers)} ]"}
        for key in ("rows", "cols", "dt", "data"):
            yield f"  <{key}>{parts[key]}</{key}>" if xml else f"   {key}: {parts[key]}"
        if xml:
            yield f"</{name}>"
    if xml:
        yield "</opencv_storage>"


def _entries(text: str) -> dict[str, Any]:
    """Names and values of a file in XML, JSON or YAML. Raises `ValueError`."""
    kind = {"<": "XML", "{": "JSON"}.get(text.lstrip()[:1], "YAML")
    try:  # OpenCV's first line is no YAML
        if kind == "XML":
            return _xml_entries(text)
        entries = parse_json(text) if kind == "JSON" else yaml.load(text.removeprefix("%YAML:1.0"), Loader=_Loader)
    except (ValueError, yaml.YAMLError, ElementTree.ParseError) as error:
        raise ValueError(f"not valid {kind}: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise ValueError("not valid YAML: lists or tables are nested too deeply") from None
    return entries if isinstance(entries, dict) else {}


def _xml_entries(text: str) -> dict[str, Any]:
    """The entries of OpenCV's XML, its matrices as `_numbers` takes them."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # with entities a small file can be huge
        raise ValueError("it declares a document type, which OpenCV's does not")

    def words(text: str | None) -> Any:
        found = (text or "").split()
        return found[0] if len(found) == 1 else found

    root = ElementTree.fromstring(text)
    return {one.tag: {part.tag: words(part.text) for part in one} if len(one) else words(one.text) for one in root}


class _Loader(yaml.BaseLoader):
    """Every scalar as text, every tag ignored (`!!opencv-matrix`), no aliases: with them a small file can be huge."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise ValueError(f"an alias stands in line {self.peek_event().start_mark.line + 1}")
        return super().compose_node(parent, index)


def _fields(entries: Mapping[str, Any]) -> dict[str, Any]:
    model = entries.get("distortion_model", entries.get("camera_model", "plumb_bob"))
    if str(model).lower() not in ("plumb_bob", "brown", "pinhole", "opencv", "radtan"):
        raise ValueError(f"the lens model {shown(model)} is not Brown's (k1, k2, p1, p2, k3)")
    matrix, distortion, *size = (
        next((_numbers(name, entries[name]) for name in names if name in entries), []) for names in _NAMES
    )
    if len(matrix) != 9:
        raise ValueError("holds no camera_matrix of 3 x 3 numbers")
    fx, skew, cx, zero, fy, cy, *last = matrix
    if skew or zero or last != [0, 0, 1] or fx <= 0 or fy <= 0:
        raise ValueError(f"camera_matrix = {shown(matrix)} is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
    if any(distortion[5:]) or len(distortion) not in (0, 4, 5, 8, 12, 14):
        known = "k1, k2, p1, p2, k3 are known, no rational, prism or tilt terms"
        raise ValueError(f"distortion_coefficients = {shown(distortion)}: {known}")
    fields = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": tuple([*distortion, *[0.0] * 5][:5])}
    for name, pixels in zip(("width", "height"), size, strict=True):
        if pixels:
            number = pixels[0] if len(pixels) == 1 else pixels
            fields[name] = check_integer(f"image_{name}", number, field_range(Camera, name))
    return fields


def _numbers(name: str, value: Any) -> list[float]:
    """The numbers of a matrix as OpenCV and ROS write it, of a list of rows, or of a list; or the one number."""
    data = value.get("data") if isinstance(value, Mapping) else value
    items = data if isinstance(data, list) else [data]
    cells = [cell for item in items for cell in (item if isinstance(item, list) else [item])]
    numbers = [read_real(name, cell, _COORDINATE) for cell in cells]
    if isinstance(value, Mapping) and value.get("rows") is not None and value.get("cols") is not None:
        rows, columns = (read_real(f"{name}.{side}", value[side], _COORDINATE) for side in ("rows", "cols"))
        if rows * columns != len(numbers):
            raise ValueError(f"{name} has {len(numbers)} numbers in {rows:g} rows and {columns:g} columns")
    return numbers
