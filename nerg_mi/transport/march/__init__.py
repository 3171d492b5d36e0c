"""The march of one ray: steps, quadrature rules, the depth that is found, and derivatives by marching again."""
