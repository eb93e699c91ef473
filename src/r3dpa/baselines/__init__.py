"""The paper's competitors, R2DM, R2Flow and LiDM, on the data, solvers and commands of r3dpa."""
