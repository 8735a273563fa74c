"""What each section of a sensor description has in common: it is checked strictly, and stays."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict


def spelt(pattern: str, words: str) -> AfterValidator:
    """Refuse a text that does not match a pattern as a whole; `words` say which text does."""

    def check(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise ValueError(words)
        return text

    return AfterValidator(check)


Name = Annotated[
    str,
    spelt(
        "[a-z][a-z0-9_]{0,62}",
        "give a name of lower-case letters, digits and _, a letter first, 63 characters at most",
    ),
]


class Section(BaseModel):
    """Base of the sections: no key that is unknown, no value of another kind."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
