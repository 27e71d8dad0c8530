"""A record as an MCAP file with Foxglove's schemas, and a layout that shows it.

    convert(reader, selection, PATH, LAYOUT, progress)

Order of the files: `instants` gathers what was said at one time, `scene` draws it, `numbers` packs what is plotted,
`writer` has the topics, `layout` the panels.

Foxglove reads all of it. Rerun does not draw scenes; it has the transforms, poses, points, fixes, log and numbers.
"""

from zsim_analysis.export.foxglove.convert import convert

__all__ = ["convert"]
