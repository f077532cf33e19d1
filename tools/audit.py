"""What we depend on: known weaknesses and a bill of materials, `python -m tools.audit [--sbom FILE]`.

Both look at the environment this runs in: run it in one that holds only `pip install rtcomp` to see what users get.
The audit asks the Python Packaging Advisory Database, so it needs the network; the bill of materials does not.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import click


def vulnerabilities() -> list[dict[str, Any]]:
    """Package, version, id and mended versions of every known weakness in this environment.

    Raises click.ClickException when the audit itself fails (no network).
    """
    command = [
        sys.executable,
        "-m",
        "pip_audit",
        "--format",
        "json",
        "--progress-spinner",
        "off",
        "--skip-editable",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if not done.stdout.strip():
        raise click.ClickException(f"pip-audit failed: {done.stderr.strip().splitlines()[-1:]}")
    return [
        {
            "package": package["name"],
            "version": package["version"],
            "id": found["id"],
            "mended": found["fix_versions"],
        }
        for package in json.loads(done.stdout)["dependencies"]
        for found in package.get("vulns", ())
    ]


def write_sbom(path: Path) -> int:
    """Write a CycloneDX bill of materials of this environment; returns how many components it lists."""
    command = [
        sys.executable,
        "-m",
        "cyclonedx_py",
        "environment",
        "--of",
        "JSON",
        "-o",
        str(path),
        sys.executable,
    ]
    subprocess.run(command, check=True, capture_output=True)
    return len(json.loads(path.read_text())["components"])


@click.command()
@click.option(
    "--sbom", type=click.Path(path_type=Path, dir_okay=False), help="Write a CycloneDX JSON file here."
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document.")
def main(sbom: Path | None, as_json: bool) -> None:
    """Audit the environment; exit status 1 when a known weakness is in it."""
    components = write_sbom(sbom) if sbom else None
    found = vulnerabilities()
    if as_json:
        click.echo(json.dumps({"vulnerabilities": found, "components": components}))
    else:
        for item in found:
            click.echo(
                f"{item['package']} {item['version']}: {item['id']}, mended in {', '.join(item['mended']) or '?'}"
            )
        listed = f"; {components} components in {sbom}" if sbom else ""
        click.echo(f"{len(found)} known weaknesses{listed}")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
