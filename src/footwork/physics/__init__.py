"""The engines that step the ant, behind one protocol (:class:`footwork.types.Physics`)."""
