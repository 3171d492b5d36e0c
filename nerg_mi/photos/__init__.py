"""Posed image sets, cameras, structure from motion (package pycolmap, extra ``poses``) and saliency maps."""
