"""The section `camera`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from spadwarp.scene import intrinsics
from spadwarp.scene.calibration import load_calibration
from spadwarp.scene.port import Port
from spadwarp.scene.sections import Brown, Coordinate, Section, Vector, Whole


def _infinite(value: Any) -> Any:
    """The word for what TOML writes as inf."""
    return math.inf if value == "infinity" else value


class Camera(Section):
    """A view through a thin lens, which fills a round aperture, or through a point with the aperture's area.

    The view is given by `horizontal_fov_deg`, by `focal_length` with `pixel_pitch_um`, or by OpenCV's `fx` (with `fy`,
    `cx`, `cy`), which `calibration` reads from a file; the aperture by `aperture_diameter`, or by `f_number` with
    `focal_length`.
    """

    section: ClassVar[str] = "camera"
    preset: str | None = None
    """a named camera, see `spadwarp list presets camera`"""
    width: Whole = Field(..., ge=1, le=16384)
    """pixels in a row"""
    height: Whole = Field(..., ge=1, le=16384)
    """rows"""
    horizontal_fov_deg: float | None = Field(None, ge=1e-6, lt=180)
    """full horizontal field of view [°]"""
    focal_length: float | None = Field(None, ge=1e-6, le=1e6)
    """focal length [m]"""
    pixel_pitch_um: float | None = Field(None, ge=1e-9, le=1e6)
    """side of a pixel [µm]"""
    fx: float | None = Field(None, ge=1e-3, le=1e9)
    """focal length along rows [pixels], as OpenCV writes it"""
    fy: float | None = Field(None, ge=1e-3, le=1e9)
    """focal length along columns [pixels]; fx if not given"""
    cx: Coordinate | None = None
    """column of the optical axis, 0 at the first pixel's centre as in OpenCV; default: the middle"""
    cy: Coordinate | None = None
    """row of the optical axis, likewise"""
    distortion: Brown = (0.0,) * 5
    """Brown's lens distortion k1, k2, p1, p2, k3, OpenCV's order"""
    calibration: str | None = None
    """OpenCV's YAML or JSON file, whose fx, fy, cx, cy and distortion take its place"""
    aperture_diameter: float | None = Field(None, ge=1e-9, le=1e6)
    """diameter of the entrance aperture [m]"""
    f_number: float | None = Field(None, ge=1e-3, le=1e6)
    """focal length over aperture diameter"""
    focus_distance: Annotated[
        Annotated[float, Field(ge=1e-6, le=math.inf, allow_inf_nan=True)] | Literal["target"],
        BeforeValidator(_infinite),
    ] = "target"
    """depth that is imaged sharply [m], inf or "infinity"; "target": that of the first target on the optical axis"""
    pinhole: bool = False
    """whether the lens is a point, which images all depths sharply and collects the light of the aperture's area"""
    position: Vector = (0.0, 0.0, 0.0)
    """lens centre in the world [m]"""
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    """rotations from the world's axes about x, then the new y, then the new z [°]"""
    polarisation: Literal["none", "analyser", "stokes"] = "none"
    """what it records of polarisation: nothing; light through an analyser and one across; the Stokes vector"""
    analyser_angle_deg: float = Field(0.0, ge=-180, le=180)
    """analyser: direction of the field that it lets through, in the image from +x towards +y [°]"""
    extinction_ratio: Annotated[
        Annotated[float, Field(ge=1, le=math.inf, allow_inf_nan=True)], BeforeValidator(_infinite)
    ] = math.inf
    """analyser: light that it lets through along its direction over light across; inf or "infinity" is ideal"""
    port: Port | None = None
    """what it looks through; view and focus are those in the air behind it. Without one it is in the water"""

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

    @model_validator(mode="after")
    def _determined(self) -> Self:
        given = [name for name in ("horizontal_fov_deg", "pixel_pitch_um", "fx") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                "needs one of horizontal_fov_deg, fx, and pixel_pitch_um with focal_length"
                + (f"; given: {', '.join(given)}" if given else "")
            )
        if (self.aperture_diameter is None) == (self.f_number is None):
            raise ValueError("needs either aperture_diameter or f_number with focal_length")
        if self.focal_length is None and (self.pixel_pitch_um is not None or self.f_number is not None):
            raise ValueError(
                f"focal_length is missing; {'pixel_pitch_um' if self.f_number is None else 'f_number'} needs it"
            )
        for name in ("fy", "cx", "cy"):
            if self.fx is None and getattr(self, name) is not None:
                raise ValueError(f"{name} = {getattr(self, name)} goes with fx only")
        if self.focus_distance != "target" and self.focus_distance <= (self.focal_length or 0.0):
            raise ValueError(
                f"focus_distance = {self.focus_distance} is outside ({self.focal_length}, inf], beyond the focal length"
            )
        if not intrinsics.is_invertible(self):
            raise ValueError(
                f"distortion = {list(self.distortion)} is not one-to-one: some of its {self.width} x {self.height} "
                "pixels show no direction, or two"
            )
        return self

    @property
    def channels(self) -> tuple[str, ...]:
        """What a result holds of polarisation: ("co", "cross") of an analyser and of one across it, the Stokes vector
        ("I", "Q", "U", "V"), or nothing."""
        return {"none": (), "analyser": ("co", "cross"), "stokes": ("I", "Q", "U", "V")}[self.polarisation]

    @property
    def tallied_channels(self) -> tuple[str, ...]:
        """Channels with tallies of their own: all but the intensity, which is the histogram."""
        return tuple(name for name in self.channels if name != "I")

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
        return (
            self.width / 2.0 if self.cx is None else self.cx + 0.5,
            self.height / 2.0 if self.cy is None else self.cy + 0.5,
        )

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
            return intrinsics.view_box(self)
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
