"""A GGUF file as a folder that `transformers serve` reads: its own GGUF path fails on files that name no architecture.

python tests/llm_prompts/unpack_gguf.py FILE.gguf FOLDER        needs transformers, gguf, accelerate
"""

from __future__ import annotations

import sys
from pathlib import Path


def unpack(file: Path, folder: Path) -> Path:
    """Weights in float32, tokenizer, chat template. Needs four times the memory of the model."""
    import torch
    from transformers import AutoModelForCausalLM, AutoTokenizer

    source = {"pretrained_model_name_or_path": str(file.parent), "gguf_file": file.name}
    loaded = AutoModelForCausalLM.from_pretrained(**source, dtype=torch.float32)
    plain = type(loaded)(loaded.config)  # saving a model that came from a GGUF is refused
    plain.load_state_dict(loaded.state_dict())
    plain.generation_config = loaded.generation_config
    plain.save_pretrained(folder)
    AutoTokenizer.from_pretrained(**source).save_pretrained(folder)
    return folder


if __name__ == "__main__":
    unpack(Path(sys.argv[1]), Path(sys.argv[2]))
