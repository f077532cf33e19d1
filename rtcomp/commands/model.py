"""`rtcomp model`: check and show a model file."""

import json

import click


@click.command("model")
@click.argument("file", required=False)
@click.option("--seal", is_flag=True, help="Write the sha256 of the model's contents into it.")
@click.option("--sign", metavar="KEY", help="Sign the model in place with a private key (and seal it).")
@click.option(
    "--new-key", metavar="FILE", help="Make a key pair: FILE (private, keep it) and FILE.pub (give it away)."
)
@click.option("--json", "as_json", is_flag=True, help="Print the checked model as JSON.")
def command(file: str | None, seal: bool, sign: str | None, new_key: str | None, as_json: bool) -> None:
    """Check a model file and show what is in it; seal it, sign it, or make the key to sign with.

    \b
    Examples:
        rtcomp model model.json
        rtcomp model edited.json --seal
        rtcomp model --new-key fleet.key
        rtcomp model model.json --sign fleet.key
    """
    from rtcomp.errors import RequestError
    from rtcomp.model import load_model, model_document, seal_model
    from rtcomp.model_text import describe_model

    if new_key is not None:
        from rtcomp.signing import new_key as make_key

        private, public = make_key(new_key)
        click.echo(
            f"private key: {private} (sign with it, keep it to yourself)\npublic key: {public}", err=True
        )
    if file is None:
        if new_key is None:
            raise RequestError("no model given; wanted `rtcomp model FILE`")
        return
    if sign is not None:
        from rtcomp.signing import sign_model

        model = sign_model(file, sign)
    else:
        model = seal_model(file) if seal else load_model(file)
    if as_json:
        click.echo(json.dumps(model_document(model)))
    else:
        describe_model(model, file)
