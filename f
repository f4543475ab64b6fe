----------------------------------------
Petsc Release Version 3.18.5, Feb 27, 2023  Mon Nov 23 23:45:26 2026
x on a , 1 proc. with options:
----------------------------------------
[0] <sys> PetscDeviceInitializeTypeFromOptions_Private(): PetscDeviceType host available, initializing
PetscDeviceType host available, initializing
[0] <sys> PetscDeviceInitializeTypeFromOptions_Private(): PetscDevice host initialized, default device id 0, view FALSE, init type lazy
PetscDevice host initialized, default device id 0, view FALSE, init type lazy
[0] <sys> PetscDeviceInitializeTypeFromOptions_Private(): PetscDeviceType cuda not available
PetscDeviceType cuda not available
[0] <sys> PetscDeviceInitializeTypeFromOptions_Private(): PetscDeviceType hip not available
PetscDeviceType hip not available
[0] <sys> PetscDeviceInitializeTypeFromOptions_Private(): PetscDeviceType sycl not available
PetscDeviceType sycl not available
[0] <sys> PetscInitialize_Common(): PETSc successfully started: number of processors = 1
PETSc successfully started: number of processors = 1
[0] <sys> PetscGetHostName(): Rejecting domainname, likely is NIS vm.(none)
Rejecting domainname, likely is NIS vm.(none)
[0] <sys> PetscInitialize_Common(): Running on machine: vm
Running on machine: vm
[0] <sys> PetscGetHostName(): Rejecting domainname, likely is NIS vm.(none)
Rejecting domainname, likely is NIS vm.(none)
[0] <sys> PetscPOpen(): Running command :x -c 'import os, sysconfig; print(os.path.join(sysconfig.get_config_var("LIBDIR"),sysconfig.get_config_var("LDLIBRARY")))'
Running command :x -c 'import os, sysconfig; print(os.path.join(sysconfig.get_config_var("LIBDIR"),sysconfig.get_config_var("LDLIBRARY")))'
[0]PETSC ERROR: 