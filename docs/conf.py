"""Sphinx configuration: ``make docs``, and rosdoc2, which docs.ros.org builds with.

Built without network: nothing is fetched, and no page loads anything.
"""

from importlib.util import find_spec
from pathlib import Path
import re
import sys

# rosdoc2 executes this text from a file in another folder, which names this file.
named = re.search(r'exec\(open\("([^"]+)"\)', Path(__file__).read_text(encoding='utf-8'))
DOCS = Path(named[1] if named else __file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

manifest = (DOCS.parent / 'package.xml').read_text(encoding='utf-8')
project = 'rs_relpose_ros'
project_copyright = 'rs_relpose_ros maintainers, Apache-2.0'
release = version = re.search(r'<version>(.*?)</version>', manifest)[1]

# numpydoc is the better reader of these docstrings; napoleon comes with Sphinx.
reader = 'numpydoc' if find_spec('numpydoc') else 'sphinx.ext.napoleon'
extensions = ['myst_parser', 'sphinx.ext.autodoc', reader]
root_doc = 'index'
# What rosdoc2 adds: copies of the README, whose links hold in the repository only, and pages of
# all modules, which are internal. api.md has the public names.
added = ['standard*', '__*_include.rst', 'modules.rst', 'rs_relpose_ros*.rst']
exclude_patterns = ['_build', 'front.md', *added]
rosdoc2_settings = {'override_theme': False}
source_suffix = {'.md': 'markdown', '.rst': 'restructuredtext'}
suppress_warnings = ['myst.strikethrough']

myst_heading_anchors = 4
myst_enable_extensions = ['colon_fence']

autodoc_member_order = 'bysource'
autodoc_typehints = 'none'  # the docstrings have shapes, units and frames
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

html_theme = 'alabaster'
# Has custom.css, which the theme loads.
html_static_path = ['_static']
html_title = f'rs_relpose_ros {release}'
html_theme_options = {
    'description': 'Relative pose of rolling-shutter images, aided by an IMU',
    'fixed_sidebar': True,
    'page_width': '1100px',
    'sidebar_width': '230px',
}
html_show_sourcelink = False

# A link to a file of the repository that is no page, such as ../benchmarks/README.md.
OUTSIDE = re.compile(r'\[([^\]]+)\]\(((?:\.\./)+[^)#]+)(?:#[^)]*)?\)')


def without_links_to_files(app, docname, source):
    """Links that leave the folder of the pages become the name of the file."""

    def replaced(match):
        target = (DOCS / docname).parent / match[2]
        if target.resolve().is_relative_to(DOCS):
            return match[0]
        return f'{match[1]} (`{match[2].replace("../", "")}`)'

    source[0] = OUTSIDE.sub(replaced, source[0])


def setup(app):
    """Register the rewriting of links."""
    app.connect('source-read', without_links_to_files)
