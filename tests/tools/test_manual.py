"""Manual pages of plugins as Markdown."""

from __future__ import annotations

from importlib import import_module

import pytest

from tools import manual

PAGE = r"""
.. _volume-fog:

Fog (:monosp:`fog`)
-------------------

.. pluginparameters::

 * - density, color
   - |float| or :paramtype:`volume`
   - How :math:`x^2` thick it is; see :ref:`nerf <volume-nerf>` and
     ``max_density``. (Default: 1)
   - |exposed|, |differentiable|

 * - depth
   - |string|
   - A word.

It is fog: :math:`a | b`.

- one
- two

.. math::

    x = 1
      + 2

.. tabs::
    .. code-tab:: xml
        :name: fog-volume

        <volume type="fog">
            <float name="density" value="2"/>
        </volume>

    .. code-tab:: python

        'type': 'fog',
"""

BODY = """It is fog: $a | b$.

- one
- two

```math
x = 1
  + 2
```

```xml
<volume type="fog">
    <float name="density" value="2"/>
</volume>
```

```python
'type': 'fog',
```"""


def test_a_page():
    page = manual.read(PAGE)
    assert page.title == "Fog (`fog`)" and page.body == BODY
    first, second = page.parameters
    assert (first.name, first.type, first.flags) == ("density, color", "float or volume", ("exposed", "differentiable"))
    assert first.meaning == "How $x^2$ thick it is; see `nerf` and `max_density`. (Default: 1)"
    assert second.flags == ()
    row = page.parameter_table().splitlines()[2]
    assert row.startswith("| `density, color` | float or volume | How") and row.endswith("differentiable)* |")


@pytest.mark.parametrize("old, new", [(".. math::", ".. figure::"), (":math:`a", ":foo:`a")])
def test_what_it_cannot_read_is_named(old, new):
    with pytest.raises(ValueError, match=r"manual\.py"):
        manual.read(PAGE.replace(old, new))


@pytest.mark.parametrize("name", ["nerg", "nerf", "splats", "gazefield", "gazekde", "panorama"])
def test_the_plugins_manuals_can_be_read(name):
    page = manual.read(import_module(f"nerg_mi.plugins.{name}").__doc__)
    assert f"`{name}`" in page.title and len(page.parameters) >= 3 and "```xml" in page.body
    assert "``" not in page.body.replace("```", "") and ":math:" not in page.body
