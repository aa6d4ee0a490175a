"""Settings for labelme that offer the classes of a taxonomy, and nothing else, in their colours.

``labelmerc.yaml`` beside this file is what `labelmerc` returns for the published classes.
"""

from __future__ import annotations

from semantic2d_dataset.scene.taxonomy import SEMANTIC2D, Taxonomy

# The names of the settings are those of labelme 5; labelme 6 takes them too, and calls
# store_data with_image_data.
_HEAD = """\
# Settings of labelme (5 or 6) for annotating a map:  labelme --config .labelmerc map.pgm
auto_save: true
store_data: false  # the map's image stays in its own file
validate_label: exact
sort_labels: false
shape_color: manual
"""


def labelmerc(taxonomy: Taxonomy = SEMANTIC2D) -> str:
    """Return the text of a ``.labelmerc`` file.

    Classes stand in the order of their ids; the background comes last, since it is chosen least.
    """
    ids = (*taxonomy.scored_ids, taxonomy.background_id)
    names = [_quoted(taxonomy.names[i]) for i in ids]
    colours = [list(taxonomy.colours[i]) for i in ids]
    lines = [
        "labels:",
        *(f"  - {name}" for name in names),
        "label_colors:",
        *(f"  {name}: {colour}" for name, colour in zip(names, colours, strict=True)),
    ]
    return _HEAD + "\n".join(lines) + "\n"


def _quoted(name: str) -> str:
    """Write a printable name as a YAML string, whatever stands in it."""
    return "'" + name.replace("'", "''") + "'"
