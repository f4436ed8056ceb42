"""What a scene consists of, as pure data: sampled once, recorded with every image, replayable.

Frame: Blender's world, metres. The table is the plane z = 0, z up. Rotations are unit quaternions (w, x, y, z)
that take the object's model frame to the world.
"""
