"""The pydantic model of one entry of a language model's reply: a module of its own, imported when one has answered."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from gsopt.llm_prompts.sanitize import LONGEST_CHARACTERS


class EntryModel(BaseModel):
    """See `gsopt.llm_prompts.reply.Entry`. Numbers are no texts, further keys are left out."""

    model_config = ConfigDict(strict=True, extra="ignore")

    text: str = Field(min_length=1, max_length=LONGEST_CHARACTERS)
    why: str = Field(default="", max_length=20_000)
