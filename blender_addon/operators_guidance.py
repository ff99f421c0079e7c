"""2 Guidance: prompts as data, proposals of a language model one by one, reference images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import bpy

from . import job_results
from .core import arguments, job, prompts
from .core.errors import UsageError
from .operator_errors import ReportingOperator, WaitingOperator
from .operators_source import begin, refuse_two
from .preferences import absolute, preferences, python, work_folder


def document(settings: Any) -> prompts.Document:
    """The panel's prompts, with what stood beside them in the file they came from."""
    listed = tuple(job_results.prompt_of(entry) for entry in settings.prompts if entry.text.strip())
    return prompts.Document(listed, prompts.parse_rest(settings.prompts_rest))


class GSOPT_OT_prompt_add(ReportingOperator, bpy.types.Operator):
    """Add a prompt"""

    bl_idname = "gsopt.prompt_add"
    bl_label = "Add Prompt"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    text: bpy.props.StringProperty(name="Text")  # type: ignore[valid-type]
    polarity: bpy.props.StringProperty(name="Polarity", default="positive")  # type: ignore[valid-type]

    def do(self, context: Any) -> None:
        settings = context.scene.gsopt
        if len(settings.prompts) >= prompts.MOST_PROMPTS:
            raise UsageError(f"There are {len(settings.prompts)} prompts, which is the most. Remove some.")
        if self.polarity not in prompts.POLARITIES:
            raise UsageError(f"`polarity` must be positive or negative, got {self.polarity!r:.40}. Pick one.")
        entry = settings.prompts.add()
        entry.text, entry.polarity = self.text, self.polarity
        settings.prompt_index = len(settings.prompts) - 1


class GSOPT_OT_prompt_remove(ReportingOperator, bpy.types.Operator):
    """Remove the prompt"""

    bl_idname = "gsopt.prompt_remove"
    bl_label = "Remove Prompt"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def do(self, context: Any) -> None:
        settings = context.scene.gsopt
        settings.prompts.remove(settings.prompt_index)
        settings.prompt_index = max(0, min(settings.prompt_index, len(settings.prompts) - 1))


class GSOPT_OT_prompts_read(ReportingOperator, bpy.types.Operator):
    """Read a prompts.json in place of these prompts"""

    bl_idname = "gsopt.prompts_read"
    bl_label = "Read Prompts"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(default="*.json", options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: Any, event: Any) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: Any) -> str:
        settings, found = context.scene.gsopt, prompts.read_prompts(absolute(self.filepath))
        settings.prompts.clear()
        for prompt in found.prompts:
            job_results.fill_prompt(settings.prompts.add(), prompt)
        settings.prompts_rest = json.dumps(found.rest)
        listed = {entry.path for entry in settings.references}
        for path in map(str, found.accepted(absolute(self.filepath).parent)):
            if path not in listed:
                settings.references.add().path = path
        return f"{len(found.prompts)} prompts"


class GSOPT_OT_prompts_write(ReportingOperator, bpy.types.Operator):
    """Write these prompts to a prompts.json, which `gsopt train --prompts` reads"""

    bl_idname = "gsopt.prompts_write"
    bl_label = "Write Prompts"

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_glob: bpy.props.StringProperty(default="*.json", options={"HIDDEN"})  # type: ignore[valid-type]
    check_existing: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: Any, event: Any) -> set[str]:
        self.filepath = self.filepath or "prompts.json"
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: Any) -> str:
        path = absolute(self.filepath)
        prompts.write_prompts(path, document(context.scene.gsopt).beside(path.parent))
        return f"Wrote {path}"


class GSOPT_OT_propose(WaitingOperator, bpy.types.Operator):
    """Have prompts written from your notes; you accept, edit or reject each of them"""

    bl_idname = "gsopt.propose"
    bl_label = "Write Prompts with the LLM"

    def do(self, context: Any) -> str:
        refuse_two(context, "prompts")
        settings, machine = context.scene.gsopt, preferences(context)
        if not settings.notes.strip():
            raise UsageError("The notes are empty. Say in a few words what the object is and what you know about it.")
        if settings.domain == "own" and not settings.template:
            raise UsageError("The domain is your own, but no template is chosen. Choose a Markdown file.")
        domain = str(absolute(settings.template)) if settings.domain == "own" else settings.domain
        writing = arguments.Writing(settings.notes, domain, llm=machine.llm or "none", model=machine.model)
        folder = job.free_folder(work_folder(context) / "jobs", "prompts")
        out = folder / "prompts.json"
        call = arguments.prompts(python(context), writing, out)
        return begin(context, self, job.start("prompts", call, folder, out))


class GSOPT_OT_proposal(ReportingOperator, bpy.types.Operator):
    """Take the first proposal as it stands now, or drop it"""

    bl_idname = "gsopt.proposal"
    bl_label = "Proposal"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    accept: bpy.props.BoolProperty(default=True, options={"SKIP_SAVE"})  # type: ignore[valid-type]
    all: bpy.props.BoolProperty(default=False, options={"SKIP_SAVE"})  # type: ignore[valid-type]

    def do(self, context: Any) -> None:
        settings = context.scene.gsopt
        if not len(settings.proposals):
            raise UsageError("There is no proposal. Have prompts written first.")
        for _ in range(len(settings.proposals) if self.all else 1):
            if self.accept:
                job_results.fill_prompt(settings.prompts.add(), job_results.prompt_of(settings.proposals[0]))
            settings.proposals.remove(0)


class GSOPT_OT_reference_add(ReportingOperator, bpy.types.Operator):
    """Add an image of the object or of its like"""

    bl_idname = "gsopt.reference_add"
    bl_label = "Add Reference Image"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    filepath: bpy.props.StringProperty(subtype="FILE_PATH")  # type: ignore[valid-type]
    filter_image: bpy.props.BoolProperty(default=True, options={"HIDDEN"})  # type: ignore[valid-type]

    def invoke(self, context: Any, event: Any) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def do(self, context: Any) -> None:
        path = absolute(self.filepath)
        if not path.is_file():
            raise UsageError(f"There is no image at {path}. Choose a file.")
        context.scene.gsopt.references.add().path = str(path)


class GSOPT_OT_reference_remove(ReportingOperator, bpy.types.Operator):
    """Remove the reference image from the list"""

    bl_idname = "gsopt.reference_remove"
    bl_label = "Remove Reference Image"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    def do(self, context: Any) -> None:
        settings = context.scene.gsopt
        settings.references.remove(settings.reference_index)
        settings.reference_index = max(0, settings.reference_index - 1)


def guidance(settings: Any, folder: Path) -> arguments.Guidance:
    """Returns the guidance options of the panel; its prompts are written into `folder`."""
    if settings.prior == "FOLDER" and not settings.prior_folder:
        raise UsageError("The prior is a folder, but none is chosen. Choose a model in diffusers' layout.")
    listed = document(settings).beside(folder)
    path = folder / "prompts.json"
    if listed.prompts and settings.prior != "off":
        folder.mkdir(parents=True, exist_ok=True)
        prompts.write_prompts(path, listed)
    return arguments.Guidance(
        prior=str(absolute(settings.prior_folder)) if settings.prior == "FOLDER" else settings.prior,
        weight=settings.lambda_sds,
        prompts=path if listed.prompts else None,
        references=tuple(absolute(entry.path) for entry in settings.references),
        device=settings.device,
        front_view=settings.front_view,
    )


CLASSES = (
    GSOPT_OT_prompt_add,
    GSOPT_OT_prompt_remove,
    GSOPT_OT_prompts_read,
    GSOPT_OT_prompts_write,
    GSOPT_OT_propose,
    GSOPT_OT_proposal,
    GSOPT_OT_reference_add,
    GSOPT_OT_reference_remove,
)
