"""Sphinx: `./deploy/docs` builds these pages without a network, every warning an error."""

project = "XRL"
author = "the XRL developers"
copyright = "the XRL developers, Apache-2.0"  # noqa: A001 - Sphinx's name
extensions = ["myst_parser", "sphinx_copybutton", "sphinx-mathjax-offline"]
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "XRL: a balance runtime for Extra Robotic Legs"
html_static_path = ["_static"]
html_css_files = ["xrl.css"]
html_show_sourcelink = False
html_copy_source = False
copybutton_prompt_text = "$ "
