! Reads a region of the first variable of a .fhz file. Arrays of C are (t, z, y, x): the shape is turned for Fortran.
program read_region
    use, intrinsic :: iso_c_binding
    implicit none
    type, bind(c) :: variable_type
        integer(c_size_t) :: size
        type(c_ptr) :: name, units, attributes
        integer(c_int32_t) :: kind, levels
        integer(c_int64_t) :: shape(4), tile(4), box(6)
        real(c_double) :: low, high, background, max_error, psnr
    end type
    type, bind(c) :: error_type
        integer(c_int32_t) :: status
        character(kind=c_char) :: text(500)
    end type
    interface
        type(c_ptr) function fhash_context_create(memory, threads) bind(c)
            import; integer(c_int64_t), value :: memory; integer(c_int32_t), value :: threads
        end function
        integer(c_int32_t) function fhash_open_path(context, path, file, error) bind(c)
            import; type(c_ptr), value :: context; character(kind=c_char) :: path(*); type(c_ptr) :: file; type(error_type) :: error
        end function
        integer(c_int32_t) function fhash_variable_get(file, number, variable, error) bind(c)
            import; type(c_ptr), value :: file; integer(c_int32_t), value :: number
            type(variable_type) :: variable; type(error_type) :: error
        end function
        integer(c_int32_t) function fhash_read(file, number, step, region, lod, kind, values, error) bind(c)
            import; type(c_ptr), value :: file; integer(c_int32_t), value :: number, lod, kind
            real(c_double), value :: step; integer(c_int64_t) :: region(6); real(c_float) :: values(*); type(error_type) :: error
        end function
        subroutine fhash_close(file) bind(c)
            import; type(c_ptr), value :: file
        end subroutine
        subroutine fhash_context_destroy(context) bind(c)
            import; type(c_ptr), value :: context
        end subroutine
    end interface
    integer(c_int32_t), parameter :: float32 = 10
    type(c_ptr) :: context, file
    type(variable_type) :: variable
    type(error_type) :: error
    integer(c_int64_t) :: region(6)
    real(c_float), allocatable :: values(:, :, :) ! (x, y, z)
    character(len=1000) :: path

    call get_command_argument(1, path)
    context = fhash_context_create(0_c_int64_t, 2_c_int32_t)
    call check(fhash_open_path(context, trim(path)//c_null_char, file, error))
    variable%size = c_sizeof(variable)
    call check(fhash_variable_get(file, 0_c_int32_t, variable, error))
    print '(a, " (", 3(i0, ", "), i0, ") ", a)', text(variable%name), variable%shape, text(variable%units)

    ! the first half of each axis, at the middle of the steps, which may lie between two
    region = [0_c_int64_t, (variable%shape(2) + 1)/2, 0_c_int64_t, (variable%shape(3) + 1)/2, 0_c_int64_t, (variable%shape(4) + 1)/2]
    allocate (values(region(6), region(4), region(2)))
    call check(fhash_read(file, 0_c_int32_t, (variable%shape(1) - 1)/2d0, region, 0_c_int32_t, float32, values, error))
    ! missing values, and those outside the features, are NaN: they differ from themselves
    print '("last ", es16.9, " mean ", es19.12, " of ", i0)', values(region(6), region(4), region(2)), &
        sum(real(values, c_double), mask=values == values)/count(values == values), count(values == values)
    call fhash_close(file)
    call fhash_context_destroy(context)
contains
    subroutine check(status)
        integer(c_int32_t), intent(in) :: status
        if (status == 0) return
        print '(500a)', error%text(:findloc(error%text, c_null_char, dim=1) - 1)
        stop 1
    end subroutine
    function text(pointer) result(found)
        type(c_ptr), intent(in) :: pointer
        character(len=:), allocatable :: found
        character(kind=c_char), pointer :: letters(:)
        integer :: i
        call c_f_pointer(pointer, letters, [1000])
        found = ''
        do i = 1, findloc(letters, c_null_char, dim=1) - 1
            found = found//letters(i)
        end do
    end function
end program
