"""What was photographed: posed image sets, cameras, structure from motion (package pycolmap, extra ``poses``),
salience."""
