"""`aeroloop log`: what happened."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from service.commands.common import (
    Json,
    guarded,
    print_figures,
)

if TYPE_CHECKING:
    from service.figures import Figures

group = typer.Typer(no_args_is_help=True, help="What happened: reads logs.")


@group.command()
def review(
    log: Annotated[Path, typer.Argument(help="An MCAP log.", show_default=False)],
    figures: Annotated[
        Path | None, typer.Option("--figures", help="Draw the paper's figures into this folder.", show_default=False)
    ] = None,
    json: Json = False,
) -> None:
    """Compute every figure of merit from a log alone, and draw the paper's figures if asked."""

    def run() -> Figures:
        from service.review import read

        judged = read(log, keep=figures is not None)
        if figures is not None:
            from service.plots import draw_figures

            for path in draw_figures(judged.session, figures):
                typer.echo(f"aeroloop: drew {path}", err=True)
        return judged.figures

    print_figures(guarded(run), json)
