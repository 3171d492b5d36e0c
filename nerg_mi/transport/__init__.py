"""Light and gaze along rays: media, the march through them and its adjoint, the observer and what hides from them."""
