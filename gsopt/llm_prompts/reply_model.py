"""The pydantic model of one entry of a language model's reply, imported on demand."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

from gsopt.llm_prompts.sanitize import MAX_CHARACTERS


class EntryModel(BaseModel):
    """See `gsopt.llm_prompts.reply.Entry`. Rejects numbers as text and ignores further keys."""

    model_config = ConfigDict(strict=True, extra="ignore")

    text: str = Field(min_length=1, max_length=MAX_CHARACTERS)
    why: str = Field(default="", max_length=20_000)
