"""Feature sources that leak labels, whose numbers no table may hold beside others."""

from __future__ import annotations

__all__ = ["leaks_labels", "refuse_leak"]

_LEAKING = ("oracle",)  # name of OracleFeatures


def leaks_labels(source: str | None) -> bool:
    """Whether features of this name, None for no features, are made from labels."""
    return source in _LEAKING


def refuse_leak(source: str | None, what: str, *, allow: bool = False) -> None:
    """Refuses to measure what was made with features that leak labels.

    Every command that reports metrics calls this on what it measures.

    Args:
        source: Feature source recorded for it, None if it used none.
        what: What is measured; appears in the error.
        allow: The user asked for it all the same.

    Raises:
        ValueError: If the source leaks and ``allow`` is not set.
    """
    if leaks_labels(source) and not allow:
        raise ValueError(
            f"{what}: made with features of {source!r}, which read the labels, so that no number "
            "of it may be compared with others. Give --allow_oracle to compute them all the same"
        )
