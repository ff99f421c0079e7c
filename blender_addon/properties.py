"""Properties of the panel; they are saved in the .blend."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from . import nodes, splat_object

SOURCES = [
    ("MESH", "Mesh", "Render views of the selected objects or of a collection of this scene"),
    ("DATASET", "Dataset", "A folder of posed images: NeRF-synthetic, nerfstudio or COLMAP"),
    ("PHOTOS", "Photos", "A folder of photos or a video whose poses are to be found"),
]
DOMAINS = [
    ("generic", "Generic", "Any object"),
    ("medicine", "Medicine", "Bones, organs, instruments"),
    ("robotics", "Robotics", "Parts, tools, things a robot handles"),
    ("arvr", "AR/VR", "Props and products shown at close range"),
    ("environment", "Environment", "Stones, plants, terrain"),
    ("own", "Own", "A template of your own"),
]
PRIORS = [
    (
        "auto",
        "As gsopt Decides",
        "One photo: the shape library. Else the embedded prior where prompts or images ask for one",
    ),
    ("off", "Off", "Photos alone decide"),
    ("embedded", "Embedded", "The small prior that comes with gsopt"),
    ("sd21", "Stable Diffusion 2.1", "The community's copy, downloaded by diffusers"),
    ("FOLDER", "Folder", "A model in diffusers' layout"),
]
PRESETS = [
    ("draft", "Draft", "About 2000 steps with more skips"),
    ("default", "Default", "4000 steps"),
    ("high", "High", "15,000 steps"),
    ("own", "Own", "As set below"),
]
STATES = [(name, name.title(), "") for name in ("NONE", "RUNNING", "DONE", "FAILED")]
DISPLAYS = [(name, name, "") for name in nodes.DISPLAYS]


def items(*names: str) -> list[tuple[str, str, str]]:
    return [(name, name.title(), "") for name in names]


class GsoptPrompt(bpy.types.PropertyGroup):
    """One prompt; the fields of prompts.json."""

    text: StringProperty(name="Text")  # type: ignore[valid-type]
    weight: FloatProperty(name="Weight", default=1.0, min=0.0, max=1000.0, soft_max=2.0)  # type: ignore[valid-type]
    view: EnumProperty(name="View", items=items("all", "front", "side", "back", "top"))  # type: ignore[valid-type]
    polarity: EnumProperty(name="Polarity", items=items("positive", "negative"))  # type: ignore[valid-type]
    source: StringProperty(name="Source", default="user")  # type: ignore[valid-type]
    rationale: StringProperty(name="Why")  # type: ignore[valid-type]
    score: FloatProperty(name="Alignment", default=-2.0)  # type: ignore[valid-type]
    """CLIP alignment with the input views; -2 where nobody measured it."""


class GsoptPath(bpy.types.PropertyGroup):
    """A file or a folder in a list."""

    path: StringProperty(name="Path", subtype="FILE_PATH")  # type: ignore[valid-type]


class GsoptJob(bpy.types.PropertyGroup):
    """A program that was started; its folder is all that is needed to find it again."""

    state: EnumProperty(items=STATES)  # type: ignore[valid-type]
    folder: StringProperty()  # type: ignore[valid-type]
    message: StringProperty()  # type: ignore[valid-type]
    share: FloatProperty(min=0.0, max=1.0)  # type: ignore[valid-type]


class GsoptScene(bpy.types.PropertyGroup):
    """The whole panel."""

    folder: StringProperty(name="Work Folder", subtype="DIR_PATH")  # type: ignore[valid-type]
    message: StringProperty()  # type: ignore[valid-type]
    doctor: StringProperty()  # type: ignore[valid-type]

    source: EnumProperty(name="Source", items=SOURCES)  # type: ignore[valid-type]
    collection: PointerProperty(  # type: ignore[valid-type]
        name="Collection", type=bpy.types.Collection, description="Rendered; empty: the selected objects"
    )
    photos: StringProperty(name="Photos", subtype="DIR_PATH")  # type: ignore[valid-type]
    dataset: StringProperty(name="Dataset", subtype="DIR_PATH")  # type: ignore[valid-type]
    render_views: IntProperty(name="Views", default=24, min=1, max=2000)  # type: ignore[valid-type]
    render_test_views: IntProperty(name="Held Out", default=6, min=0, max=2000)  # type: ignore[valid-type]
    render_size: IntProperty(name="Pixels", default=256, min=16, max=8192)  # type: ignore[valid-type]
    render_samples: IntProperty(name="Samples", default=32, min=1, max=65536)  # type: ignore[valid-type]
    render_layout: EnumProperty(name="Layout", items=items("hemisphere", "sphere", "orbit", "spiral"))  # type: ignore[valid-type]

    domain: EnumProperty(name="Domain", items=DOMAINS)  # type: ignore[valid-type]
    template: StringProperty(name="Template", subtype="FILE_PATH")  # type: ignore[valid-type]
    notes: StringProperty(
        name="Notes", description="What you know about it: material, parts, wear, what no photo shows"
    )  # type: ignore[valid-type]
    prompts: CollectionProperty(type=GsoptPrompt)  # type: ignore[valid-type]
    prompt_index: IntProperty()  # type: ignore[valid-type]
    prompts_rest: StringProperty()  # type: ignore[valid-type]
    """The other keys of the prompts.json that was read, as JSON."""
    proposals: CollectionProperty(type=GsoptPrompt)  # type: ignore[valid-type]
    references: CollectionProperty(type=GsoptPath)  # type: ignore[valid-type]
    reference_index: IntProperty()  # type: ignore[valid-type]
    prior: EnumProperty(name="Prior", items=PRIORS)  # type: ignore[valid-type]
    prior_folder: StringProperty(name="Model", subtype="DIR_PATH")  # type: ignore[valid-type]
    lambda_sds: FloatProperty(name="Weight", default=0.2, min=0.0, soft_max=1.0)  # type: ignore[valid-type]
    front_view: IntProperty(
        name="Front View", default=-1, min=-1, description="Number of the input view that shows the front; -1: not said"
    )  # type: ignore[valid-type]

    preset: EnumProperty(name="Preset", items=PRESETS, default="default")  # type: ignore[valid-type]
    iterations: IntProperty(name="Steps", default=4000, min=1)  # type: ignore[valid-type]
    downscale: IntProperty(
        name="Divide Size by", default=0, min=0, max=16, description="1: all pixels; 0: at most 1600 px on a side"
    )  # type: ignore[valid-type]
    budget: IntProperty(name="Most Gaussians", default=0, min=0, description="0: as many as the images call for")  # type: ignore[valid-type]
    views: IntProperty(name="Input Views", default=0, min=0, description="Learn from this many; 0: all")  # type: ignore[valid-type]
    hold_out: BoolProperty(name="Hold out Every 8th", default=False)  # type: ignore[valid-type]
    strategy: EnumProperty(name="Density", items=[("adc", "ADC", ""), ("mcmc", "MCMC", "")])  # type: ignore[valid-type]
    background: EnumProperty(name="Background", items=items("auto", "white", "black", "random"))  # type: ignore[valid-type]
    device: EnumProperty(name="Prior on", items=[("auto", "Auto", ""), ("cpu", "CPU", ""), ("cuda", "GPU", "")])  # type: ignore[valid-type]
    threads: IntProperty(name="Threads", default=0, min=0, description="0: one per core")  # type: ignore[valid-type]
    seed: IntProperty(name="Seed", default=0, min=0)  # type: ignore[valid-type]
    live: BoolProperty(name="Live Preview", default=True)  # type: ignore[valid-type]
    live_most: IntProperty(name="Most in Preview", default=20_000, min=100, max=1_000_000)  # type: ignore[valid-type]

    job_dataset: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]
    job_poses: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]
    job_masks: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]
    job_prompts: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]
    job_doctor: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]
    job_install: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]
    job_page: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]
    job_clean: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]
    job_measure: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]
    known_length: FloatProperty(  # type: ignore[valid-type]
        name="Known Length",
        default=1.0,
        min=1e-6,
        unit="LENGTH",
        description="True length between the two chosen splats",
    )
    job_mesh: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]
    job_import: PointerProperty(type=GsoptJob)  # type: ignore[valid-type]

    run_path: StringProperty(name="Run", subtype="DIR_PATH")  # type: ignore[valid-type]
    run_job: StringProperty()  # type: ignore[valid-type]
    """Folder of the job that makes the run."""
    run_status: StringProperty(default="")  # type: ignore[valid-type]
    run_step: IntProperty()  # type: ignore[valid-type]
    run_total: IntProperty()  # type: ignore[valid-type]
    run_count: IntProperty()  # type: ignore[valid-type]
    run_psnr: FloatProperty(default=-1.0)  # type: ignore[valid-type]
    run_eta: FloatProperty(default=-1.0)  # type: ignore[valid-type]
    run_message: StringProperty()  # type: ignore[valid-type]
    run_preview: StringProperty()  # type: ignore[valid-type]
    runs: CollectionProperty(type=GsoptPath)  # type: ignore[valid-type]
    runs_index: IntProperty()  # type: ignore[valid-type]

    display: EnumProperty(name="Show as", items=DISPLAYS, default="Ellipsoids")  # type: ignore[valid-type]
    most_shown: IntProperty(name="Most Shown", default=100_000, min=1)  # type: ignore[valid-type]
    up: EnumProperty(  # type: ignore[valid-type]
        name="Up",
        items=[
            ("DATASET", "As the Dataset Says", "Back where the rendered object stands, else as in the file"),
            ("Z", "As in the File", "The file's axes are Blender's"),
            ("MINUS_Y", "File's -Y", "Photos posed by COLMAP look along +z with y down: turned upright"),
        ],
    )
    least_opacity: FloatProperty(name="Least Opacity", default=0.05, min=0.0, max=1.0)  # type: ignore[valid-type]
    largest_scale: FloatProperty(name="Largest Scale", default=0.0, min=0.0, description="0: any")  # type: ignore[valid-type]
    farthest: FloatProperty(name="Farthest", default=0.0, min=0.0, description="From the center; 0: any")  # type: ignore[valid-type]
    center: FloatVectorProperty(name="Center", size=3, subtype="XYZ")  # type: ignore[valid-type]
    box: PointerProperty(name="Box", type=bpy.types.Object, description="Keep what lies in this object's bounds")  # type: ignore[valid-type]
    no_outliers: BoolProperty(name="Without Outliers", default=False)  # type: ignore[valid-type]
    picture: FloatProperty(
        name="Input Picture", default=0.5, min=0.0, max=1.0, update=lambda self, context: blend_pictures(self)
    )  # type: ignore[valid-type]


def blend_pictures(settings: Any) -> None:
    """Apply the opacity of the input image to the scene's camera."""
    camera = settings.id_data.camera
    if camera is not None and camera.type == "CAMERA":
        for picture in camera.data.background_images:
            picture.alpha = settings.picture


def shows(name: str) -> Any:
    """An update function that passes a property on to the node group."""

    def update(self: Any, context: Any) -> None:
        modifier = splat_object.modifier_of(self.id_data)
        if modifier is not None:
            splat_object.set_input(modifier, name, getattr(self, name.lower().replace(" ", "_")))

    return update


class GsoptObject(bpy.types.PropertyGroup):
    """Display of one object's splats."""

    run: StringProperty()  # type: ignore[valid-type]
    """Run directory or file they came from."""
    display: EnumProperty(name="Show as", items=DISPLAYS, default="Ellipsoids", update=shows("Display"))  # type: ignore[valid-type]
    size: FloatProperty(
        name="Size",
        default=1.0,
        min=0.0,
        max=10.0,
        soft_max=2.0,
        update=shows("Size"),
        description="1: as learned; towards 0: a point cloud",
    )  # type: ignore[valid-type]
    extent: FloatProperty(
        name="Extent",
        default=2.0,
        min=0.01,
        max=10.0,
        update=shows("Extent"),
        description="Standard deviations that spheres and ellipsoids reach to",
    )  # type: ignore[valid-type]
    least_opacity: FloatProperty(name="Least Opacity", default=0.0, min=0.0, max=1.0, update=shows("Least Opacity"))  # type: ignore[valid-type]
    most_shown: IntProperty(name="Most Shown", default=100_000, min=1, update=shows("Most Shown"))  # type: ignore[valid-type]
    color_by_view: BoolProperty(
        name="Color by View",
        default=True,
        update=shows("Color by View"),
        description="Harmonics as seen from the scene's camera",
    )  # type: ignore[valid-type]
    linear_color: BoolProperty(
        name="Linear Color",
        default=True,
        update=shows("Linear Color"),
        description="Off: coded values for the view transform Raw",
    )  # type: ignore[valid-type]


CLASSES = (GsoptPrompt, GsoptPath, GsoptJob, GsoptScene, GsoptObject)
