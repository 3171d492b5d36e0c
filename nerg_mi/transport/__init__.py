"""What a ray sees of any density: quadrature, marching, depth, visibility. Pure maths."""
