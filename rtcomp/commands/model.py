"""`rtcomp model`: check and show a model file."""

import json

import click


@click.command("model")
@click.argument("file", required=False)
@click.option("--seal", is_flag=True, help="Write the sha256 of the model's contents into it.")
@click.option("--json", "as_json", is_flag=True, help="Print the checked model as JSON.")
def command(file: str | None, seal: bool, as_json: bool) -> None:
    """Check a model file and show what is in it.

    \b
    Examples:
        rtcomp model model.json
        rtcomp model edited.json --seal
    """
    from rtcomp.errors import RequestError
    from rtcomp.model import load_model, model_document, seal_model
    from rtcomp.model_text import describe_model

    if file is None:
        raise RequestError("no model given; wanted `rtcomp model FILE`")
    model = seal_model(file) if seal else load_model(file)
    if as_json:
        click.echo(json.dumps(model_document(model)))
    else:
        describe_model(model, file)
