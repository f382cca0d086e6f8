"""`gsparc data` lists public sets of measurements; `gsparc data NAME...` fetches them."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Sequence

from rich.console import Console

from gsparc.base.errors import DataError
from gsparc.datasets.public.fetch import MIRROR, PublicSet, fetch, public_sets


def describe_set(one: PublicSet) -> str:
    """Say what a set is, its size and licence, how it is used and cited,
    and where it comes from.
    """
    size = one.size_text if one.sources else "size shown before fetching" if one.hub else "by hand"
    licence = one.licence or "no licence stated: ask its makers before you pass it on"
    use = f"dataset={one.dataset}" if one.dataset else "no loader of its own"
    first = one.sources[0] if one.sources else None
    hub = f"huggingface.co/datasets/{one.hub}, folder {one.strip}" if one.hub else one.by_hand
    where = f"github.com/{first.repository} at {first.revision[:10]}" if first else hub
    return (
        f"{one.name}: {one.what}\n    {size}; {licence}; {use}\n    cite {one.cite}\n    from "
        f"{where}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; exit status 0 when everything named is there, else 1."""
    parser = argparse.ArgumentParser(prog="gsparc data", description=__doc__)
    parser.add_argument(
        "name", nargs="*", help=f"sets to fetch, from GitHub or from the mirror {MIRROR}"
    )
    parser.add_argument(
        "accept", nargs="?", help="accept=true: also where the makers state no licence"
    )
    # argparse tells positional words by their place only: `accept=true` may stand anywhere.
    words = parser.parse_args(arguments).name
    console, failed = Console(soft_wrap=True, highlight=False), 0
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    names = [word for word in words if word != "accept=true"]
    for public_set in () if names else public_sets().values():
        console.print(describe_set(public_set), markup=False)
    for name in names:
        # One by one: what comes after a set that fails is fetched all the same.
        try:
            folder = fetch(name, accept="accept=true" in words)
            use = public_sets()[name].dataset
            console.print(
                f"{name}: {folder}{f', read by dataset={use}' if use else ''}", markup=False
            )
        except DataError as error:
            # To stderr, so that a list piped elsewhere holds sets alone.
            Console(stderr=True, soft_wrap=True).print(
                f"error: {error}", markup=False, highlight=False
            )
            failed = 1
    return failed
